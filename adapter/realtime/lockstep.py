"""The live tick in one thread and without a clock: for trials and tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from adapter.controller import Controller
from adapter.realtime.jobs import LearnerLike
from adapter.realtime.session import FrontEndLike, Session, stop_arm
from adapter.records import Array
from drivers.interface import Driver, JointSample


@dataclass(frozen=True)
class LockstepResult:
    """What a lockstep run did; fields as in `LiveResult`."""

    samples: int
    set_aside: int
    passed_on: int
    ended: str
    fault: str | None
    tracking: dict[str, Any] | None


def run_lockstep(
    driver: Driver,
    front_end: FrontEndLike,
    learner: LearnerLike | None = None,
    controller: Controller | None = None,
    duration_s: float | None = None,
    *,
    each: Callable[[JointSample, Array | None], None] | None = None,
) -> LockstepResult:
    """Run an arm as fast as it goes; the learner sees what it would see live.

    Args:
        driver: not connected yet; stopped but left open at the end, for questions to it.
        front_end: fresh.
        learner: takes each filtered state before the next sample is read.
        controller: moves the arm; None listens.
        duration_s: of the arm's own stamps, until the safe stop begins; None runs to the end of
            the stream.
        each: called at the end of each tick with the sample and the command.

    Raises:
        DriverError: the arm cannot be reached.
    """
    passed_on = 0

    def learn(record: Array) -> None:
        nonlocal passed_on
        passed_on += 1
        if learner is not None:
            learner.step(record)

    def keep(sample: JointSample, command: Array | None) -> None:
        if each is not None:
            each(sample, command)

    driver.connect()
    session = Session(driver, front_end, controller, learn, keep, duration_s)
    try:
        if controller is not None:
            session.get_ready(controller.prepare)
        while session.tick():
            pass
    finally:
        stop_arm(driver, session)
    tracking = None if controller is None else controller.tracking()
    return LockstepResult(
        session.samples, session.set_aside, passed_on, session.ended, session.fault, tracking
    )
