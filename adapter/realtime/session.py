"""One tick of an arm being learned, and when it ends: the same live and in lockstep.

`run_lockstep` runs the ticks in one thread and without a clock, for trials and tests.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from enum import StrEnum
from typing import Any

from adapter.control.controller import ExcitationController
from adapter.control.reading_gate import SampleClock
from adapter.errors import ControlError, SettingsError
from adapter.model.spatial import Array
from adapter.realtime.following import FollowingObserver
from adapter.signals.front_end import FrontEnd
from drivers.interface import Driver, DriverError, EndOfStream, JointSample


class Ended(StrEnum):
    """Why a run came to its end."""

    DURATION = "duration"
    INTERRUPTED = "interrupted"
    OPERATOR_GONE = "operator_gone"
    DRIVER_ERROR = "driver_error"
    END_OF_STREAM = "end_of_stream"


class Session:
    """Ticks of one run.

    Args:
        driver: connected.
        front_end: takes the samples.
        controller: moves the arm; None listens.
        pass_on: takes each filtered state; it must copy what it keeps.
        keep: takes each sample, the command given upon it and the external torque, if any.
        duration_s: of the arm's own stamps, until the safe stop begins; None for no end.

    Attributes:
        observer: takes each sample; None where nobody wants to know what pushes the arm.
        samples: read so far.
        set_aside: read to get ready, before the first tick; nobody else saw them.
        passed_on: filtered states.
        elapsed_s: on the arm's own stamps; one that leaps by more than a second counts a period.
        ended: why the run came to its end, see `Ended`.
        fault: what the driver or the controller said, or None.
        began_ns, had_ns, stepped_ns: instants (CLOCK_MONOTONIC) of the begin of the last tick's
            compute, of its sample being there and of its filtered state.
        stopped: the driver was told to stop.
    """

    def __init__(
        self,
        driver: Driver,
        front_end: FrontEnd,
        controller: ExcitationController | None,
        pass_on: Callable[[Array], None],
        keep: Callable[[JointSample, Array | None, Array | None], None],
        duration_s: float | None,
    ) -> None:
        self.observer: FollowingObserver | None = None
        self._driver, self._front_end, self._controller = driver, front_end, controller
        self._pass_on, self._keep, self._duration_s = pass_on, keep, duration_s
        self.samples, self.set_aside, self.passed_on, self.elapsed_s = 0, 0, 0, 0.0
        self.ended = Ended.DURATION
        self.fault: str | None = None
        self.began_ns = self.had_ns = self.stepped_ns = 0
        self.stopped = False
        # ns; a longer step of the stamps is a clock that was set
        self._elapsed_ns, self._clock = 0, SampleClock(driver.period_ns, 1_000_000_000)
        self._stopping_at_s: float | None = None
        self._ready_sample: JointSample | None = None
        if controller is not None:
            controller.attend(driver)

    def get_ready(self, prepare: Callable[[JointSample], None]) -> JointSample:
        """Read until a sample will do and prepare with it; where the arm waits for its next
        command, the first tick takes that sample.

        Args:
            prepare: raises SettingsError for a sample that will not do.

        Raises:
            SettingsError: no sample would do.
            DriverError: as the driver says.
        """
        driver = self._driver
        for left in reversed(range(200)):  # one of these can be started from
            sample = driver.read()
            try:
                prepare(sample)
            except SettingsError:
                self.set_aside += 1
                if not left:
                    raise
                self._let_pass()
                continue
            if driver.paced:
                self.set_aside += 1
            else:
                self._ready_sample = sample
            return sample
        raise AssertionError("unreachable")

    def _let_pass(self) -> None:
        """Wait until there can be another sample, where the driver does not and time goes on."""
        if self._driver.arrived_ns and not self._driver.paced:
            time.sleep(1e-9 * self._driver.period_ns)

    def catch_up(self) -> None:
        """Let pass what came in while nobody read, so that the first tick's sample is a new one.

        Where time stands still between two reads nothing came. Raises DriverError.
        """
        driver = self._driver
        if not driver.arrived_ns:
            return
        self._ready_sample = None
        for k in range(5000):
            self._let_pass()
            driver.read()
            self.set_aside += 1
            new = time.monotonic_ns() - driver.arrived_ns < 2 * driver.period_ns
            if new and k >= 3:  # a driver may look one tick back
                return

    def tick(self) -> bool:
        """Read, filter, pass on, control, record; false where the run has come to its end."""
        driver = self._driver
        self.began_ns = time.monotonic_ns()
        try:
            sample, self._ready_sample = self._ready_sample or driver.read(), None
        except EndOfStream as end:
            return self._end(Ended.END_OF_STREAM, str(end))
        except DriverError as error:
            return self._end(Ended.DRIVER_ERROR, str(error))
        self.had_ns = time.monotonic_ns()
        if driver.paced:
            self.began_ns = self.had_ns  # until here it waited for the arm
        states = self._front_end.step(sample)
        self.stepped_ns = time.monotonic_ns()
        self.samples += 1
        for state in states:
            self._pass_on(state)
        self.passed_on += len(states)
        external = None if self.observer is None else self.observer.step(sample)
        command, trouble = self._move(sample)
        self._keep(sample, command, external)
        if trouble is not None:
            return self._end(Ended.DRIVER_ERROR, trouble)
        self._elapsed_ns += self._clock.step(sample.stamp_ns)
        self.elapsed_s = 1e-9 * self._elapsed_ns
        if self._duration_s is not None and self.elapsed_s >= self._duration_s:
            self.begin_stop(Ended.DURATION)
        if self._stopping_at_s is None:
            return True
        if self._controller is None or self._controller.at_rest:
            return False
        return self.elapsed_s < self._stopping_at_s + 5.0  # s; then the driver stops it

    def _move(self, sample: JointSample) -> tuple[Array | None, str | None]:
        if self._controller is None:
            return None, None
        if self.observer is not None and self.observer.alarm is not None:
            return None, self.observer.alarm
        try:
            # Where time goes on between two reads, the instant of this one says how far.
            tau = self._controller.step(sample, self.had_ns if self._driver.arrived_ns else 0)
            self._driver.command(tau)
        except (ControlError, DriverError) as error:
            return None, str(error)
        return tau, None

    @property
    def tracking(self) -> dict[str, Any] | None:
        """See `ExcitationController.tracking`; None in passive mode."""
        return None if self._controller is None else self._controller.tracking()

    def begin_stop(self, why: Ended) -> None:
        """Begin the safe stop; the run ends when the arm rests. Later calls change nothing."""
        if self._stopping_at_s is None:
            self._stopping_at_s, self.ended = self.elapsed_s, why
            if self._controller is not None:
                self._controller.begin_stop()

    def _end(self, why: Ended, fault: str) -> bool:
        self.ended, self.fault = why, None if why == Ended.END_OF_STREAM else fault
        return False


def stop_arm(driver: Driver, session: Session | None) -> None:
    """Let the driver bring the arm to a stand, once; a failure is told as the fault."""
    if session is not None:
        if session.stopped:
            return
        session.stopped = True
    try:
        driver.stop()
    except Exception as error:  # whatever it is, the files still have to be closed
        if session is not None and session.fault is None:
            session.ended, session.fault = Ended.DRIVER_ERROR, str(error) or type(error).__name__


def run_lockstep(
    driver: Driver,
    front_end: FrontEnd,
    learner: Any = None,
    controller: ExcitationController | None = None,
    duration_s: float | None = None,
    *,
    each: Callable[[JointSample, Array | None], None] | None = None,
) -> Session:
    """Run an arm as fast as it goes; the learner sees what it would see live.

    Args:
        driver: not connected yet; stopped but left open at the end, for questions to it.
        front_end: fresh.
        learner: its `step` takes each filtered state before the next sample is read.
        controller: moves the arm; None listens.
        duration_s: of the arm's own stamps, until the safe stop begins; None runs to the end of
            the stream.
        each: called at the end of each tick with the sample and the command.

    Raises:
        DriverError: the arm cannot be reached.
    """

    def learn(record: Array) -> None:
        if learner is not None:
            learner.step(record)

    def keep(sample: JointSample, command: Array | None, external: Array | None) -> None:
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
    return session
