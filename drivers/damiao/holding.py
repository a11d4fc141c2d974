"""The loop's process holds the arm itself: after connecting, and when it stops."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from drivers.damiao.brake import Braker
from drivers.damiao.codec import Limits
from drivers.damiao.link import Link
from drivers.interface import DriverError

STEP_S = 0.002
SETTLE_AT_MOST_S, REST_S, RESTING = 5.0, 0.15, 0.05  # s, s, rad/s
SETTLE_SHARE, ADOPTIONS = 0.03, 2  # of each step's torque in the mean; times it is carried anew
STOP_AT_MOST_S, HELD_S = 1.5, 0.5


def settle(
    link: Link, limits: Sequence[Limits], carried: Sequence[float], beat: Callable[[], None]
) -> tuple[list[float], list[float]]:
    """Hold the arm until it rests and its weight is known: it gives in a little at first.

    What it was measured to be carried with at rest then carries it, so that it comes back to
    where it was, and the first sample has the torques that a controller starts from.

    Args:
        link: with a state of every motor.
        limits: of each motor.
        carried: (n) torques to begin with, N m.
        beat: called in each step.

    Returns:
        (n) angles held, rad; (n) torques that carry the arm, N m.
    """
    hold = link.motion()[0]
    braker = Braker(limits, carried, hold)
    mean, now, wanted = list(carried), list(carried), list(carried)
    adopted, rest_s = 0, 0.0
    for _ in range(round(SETTLE_AT_MOST_S / STEP_S)):
        _step(link, braker, beat)
        mean = _towards(mean, [reading[3] for reading in link.inbox.latest])
        now = _towards(now, wanted)
        braker.carry(now)
        rest_s = rest_s + STEP_S if max(map(abs, link.motion()[1])) < RESTING else 0.0
        if rest_s >= REST_S:
            if adopted == ADOPTIONS:
                return hold, mean
            wanted, rest_s = mean, 0.0
            adopted += 1
    link.inbox.note(
        "restless",
        f"the arm has not come to rest within {SETTLE_AT_MOST_S:g} s of being held; its first "
        "torques may not be those of its weight",
    )
    return hold, mean


def brake(
    link: Link, limits: Sequence[Limits], carried: Sequence[float], beat: Callable[[], None]
) -> list[float]:
    """Bring the arm to a stand and hold it; the angles held, rad.

    Arguments as for `settle`. Raises DriverError where nothing can be sent any more.
    """
    braker = Braker(limits, carried)
    for _ in range(round(STOP_AT_MOST_S / STEP_S)):
        _step(link, braker, beat)
        if braker.holding_s > HELD_S:
            break
    return braker.hold or link.motion()[0]


def _step(link: Link, braker: Braker, beat: Callable[[], None]) -> None:
    beat()
    link.command(braker.commands(STEP_S, *link.motion()))
    time.sleep(STEP_S)
    try:
        link.receive()
    except DriverError as error:  # a fault of one motor does not keep the others from holding
        link.inbox.note(f"holding: {error}", str(error))


def _towards(old: Sequence[float], new: Sequence[float]) -> list[float]:
    return [a + SETTLE_SHARE * (b - a) for a, b in zip(old, new, strict=True)]
