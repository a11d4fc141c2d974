"""How a moving arm is braked by its own motors and then held.

There is no brake in these motors: a motor that is switched off lets go. So the arm is first
damped (speed zero wanted, its weight carried by the torque measured last), and once it is slow
held where it is, with stiffness coming in over `FADE_S`. `Braker` says with which commands, and
knows no clock and no bus; `settle` and `brake` run it in the loop's process, the guardian in its.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from drivers.damiao.codec import KD_MAX, KP_MAX, Scales, mit_command
from drivers.damiao.stream import MotorStream
from drivers.interface import DriverError

FADE_S = 0.2
SINK_S = 3.0  # over which a held arm is let down
STEP_S = 0.002
SETTLE_AT_MOST_S, REST_S, RESTING = 5.0, 0.15, 0.05  # s, s, rad/s
STOP_AT_MOST_S, HELD_S = 1.5, 0.5
# A driven arm that stands still and is pushed nevertheless: shares of TMAX, s, rad/s. Further away
# than the limits of the loop itself, for which this is the second look. An arm that is free leaves
# the band of speed in 15 ms under such a torque unless its inertia is above 0.11 kg m² for each N m
# of TMAX, more than a motor could move well; three reports, so that no single one does it.
PUSH_SHARE, PUSH_S, PUSH_REPORTS = 0.75, 0.015, 3
FULL_SHARE, FULL_S = 0.8, 0.3
STANDING = 0.05


def gains(limits: Scales) -> tuple[float, float]:
    """(kp, kd) that hold a joint, N m/rad and N m s/rad."""
    # own choice: full torque at 0.25 rad; DM8009 216, DM4340 112, DM4310 40 N m/rad
    kp = min(4.0 * limits.tau_max, KP_MAX)
    return kp, min(0.05 * kp, KD_MAX)  # kd over kp, s


class Braker:
    """Commands that bring an arm from any motion to a stand and hold it there.

    Args:
        limits: of each motor.
        tau: (n) torques that carry the arm, N m: measured last.
        hold: (n) angles to hold from the start, rad; None brakes first.

    Attributes:
        hold: angles held, rad; None while braking.
        holding_s: for how long.
        yields: the held angles come after an arm that is kept away from them.
    """

    def __init__(
        self, limits: Sequence[Scales], tau: Sequence[float], hold: Sequence[float] | None = None
    ) -> None:
        self._limits = limits
        self._gains = [gains(limit) for limit in limits]
        self._tau = [value if math.isfinite(value) else 0.0 for value in tau]
        self.hold = None if hold is None else list(hold)
        self.holding_s = math.inf if hold is not None else 0.0
        self.yields = True
        self._braking_s = 0.0

    def commands(self, dt_s: float, q: Sequence[float], dq: Sequence[float]) -> list[bytes]:
        """The next MIT commands.

        Args:
            dt_s: since the last call.
            q, dq: (n) measured last, rad, rad/s; NaN for a joint that does not answer.
        """
        if self.hold is not None:
            self.holding_s += dt_s
            if self.yields:
                # What something keeps from its place is not pushed for good: beyond 15 % of TMAX in
                # the spring the angle comes after it, slowly enough for a load that was put on.
                step = 0.2 * dt_s  # rad/s
                for j, limit in enumerate(self._limits):
                    most = 0.15 * limit.tau_max / self._gains[j][0]
                    away = self.hold[j] - q[j]
                    if abs(away) > most:
                        self.hold[j] -= math.copysign(min(abs(away) - most, step), away)
        else:
            self._braking_s += dt_s
            slow = all(abs(speed) < 0.1 for speed in dq if speed == speed)  # rad/s
            if (slow and self._braking_s > 2 * dt_s) or self._braking_s >= 0.5:  # s
                self.hold, self.holding_s = list(q), 0.0
        share = min(self.holding_s / FADE_S, 1.0) if self.hold is not None else 0.0
        return [self._command(j, share, q[j]) for j in range(len(self._limits))]

    def _command(self, j: int, share: float, q_now: float) -> bytes:
        kp, kd = self._gains[j]
        q = 0.0
        if self.hold is not None:
            if self.hold[j] != self.hold[j]:
                self.hold[j] = q_now  # it answers again
            q = self.hold[j]
        if q != q:  # nothing is known of it: damp only
            q, share = 0.0, 0.0
        return mit_command(self._limits[j], q=q, kp=share * kp, kd=kd, tau=self._tau[j])

    def carry(self, tau: Sequence[float]) -> None:
        """Carry the arm with these torques from now on, (n) N m; NaN leaves a joint's as it is."""
        self._tau = [new if new == new else old for new, old in zip(tau, self._tau, strict=True)]

    def sinking(self, share: float) -> list[bytes]:
        """Commands that let the arm down: its weight is carried to `share`, speed damped."""
        return [
            mit_command(limit, kd=gain[1], tau=share * tau)
            for limit, gain, tau in zip(self._limits, self._gains, self._tau, strict=True)
        ]


class Push(NamedTuple):
    """A joint (from 0) that is pushed although it stands still: torque and its limit, N m."""

    joint: int
    torque: float
    limit: float

    def said(self, name: str) -> str:
        """In a sentence's beginning."""
        return (
            f"joint {self.joint + 1} ({name}) is pushed with {self.torque:+.1f} N m (limit "
            f"{self.limit:.1f} N m) although it stands still"
        )


class PushWatch:
    """Finds a driven arm that is pushed although it stands still.

    Args:
        limits: of each motor.
    """

    def __init__(self, limits: Sequence[Scales]) -> None:
        self._most = [limit.tau_max for limit in limits]
        self.reset()

    def reset(self) -> None:
        """The arm is driven anew."""
        self._pushed_s = [0.0] * len(self._most)
        self._pushed = [0] * len(self._most)
        self._full_s = [0.0] * len(self._most)

    def step(
        self, dt_s: float, dq: Sequence[float], carried: Sequence[float], tau: Sequence[float]
    ) -> Push | None:
        """What is pushed for too long; None for nothing.

        Args:
            dt_s: since the last call, each one with a report of its own.
            dq: (n) rad/s; carried, tau: (n) N m that carry the arm, and that were measured.
        """
        for j, most in enumerate(self._most):
            stands = abs(dq[j]) < STANDING
            pushed = stands and abs(tau[j] - carried[j]) > PUSH_SHARE * most
            full = stands and abs(tau[j]) > FULL_SHARE * most
            self._pushed_s[j] = self._pushed_s[j] + dt_s if pushed else 0.0
            self._pushed[j] = self._pushed[j] + 1 if pushed else 0
            self._full_s[j] = self._full_s[j] + dt_s if full else 0.0
            if self._pushed_s[j] > PUSH_S and self._pushed[j] >= PUSH_REPORTS:
                return Push(j, tau[j] - carried[j], PUSH_SHARE * most)
            if self._full_s[j] > FULL_S:
                return Push(j, tau[j], FULL_SHARE * most)
        return None


def settle(
    stream: MotorStream,
    limits: Sequence[Scales],
    carried: Sequence[float],
    beat: Callable[[], None],
) -> tuple[list[float], list[float]]:
    """Hold the arm until it rests and its weight is known: it gives in a little at first.

    What it was measured to be carried with at rest then carries it, so that it comes back to
    where it was, and the first sample has the torques that a controller starts from.

    Args:
        stream: with a state of every motor.
        limits: of each motor.
        carried: (n) torques to begin with, N m.
        beat: called in each step.

    Returns:
        (n) angles held, rad; (n) torques that carry the arm, N m.
    """
    hold = stream.motion()[0]
    braker = Braker(limits, carried, list(hold))
    braker.yields = False  # what carries it is not known yet
    mean, now, wanted = list(carried), list(carried), list(carried)
    adopted, rest_s = 0, 0.0
    for _ in range(round(SETTLE_AT_MOST_S / STEP_S)):
        _step(stream, braker, beat)
        mean = _towards(mean, [reading[3] for reading in stream.replies.latest])
        now = _towards(now, wanted)
        braker.carry(now)
        rest_s = rest_s + STEP_S if max(map(abs, stream.motion()[1])) < RESTING else 0.0
        if rest_s >= REST_S:
            if adopted == 2:
                return hold, mean
            wanted, rest_s = mean, 0.0
            adopted += 1
    stream.replies.intake.note(
        "restless",
        f"the arm has not come to rest within {SETTLE_AT_MOST_S:g} s of being held; its first "
        "torques may not be those of its weight",
    )
    return hold, mean


def brake(
    stream: MotorStream,
    limits: Sequence[Scales],
    carried: Sequence[float],
    beat: Callable[[], None],
) -> list[float]:
    """Bring the arm to a stand and hold it; the angles held, rad.

    Arguments as for `settle`. Raises DriverError where nothing can be sent any more.
    """
    braker = Braker(limits, carried)
    for _ in range(round(STOP_AT_MOST_S / STEP_S)):
        _step(stream, braker, beat)
        if braker.holding_s > HELD_S:
            break
    return braker.hold or stream.motion()[0]


def _step(stream: MotorStream, braker: Braker, beat: Callable[[], None]) -> None:
    beat()
    stream.command(braker.commands(STEP_S, *stream.motion()))
    time.sleep(STEP_S)
    try:
        stream.receive()
    except DriverError as error:  # a fault of one motor does not keep the others from holding
        stream.replies.intake.note(f"holding: {error}", str(error))


def _towards(old: Sequence[float], new: Sequence[float]) -> list[float]:
    return [a + 0.03 * (b - a) for a, b in zip(old, new, strict=True)]
