"""One tick of an arm being learned, and when it ends: the same live and in lockstep."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from adapter.controller import ControlError, Controller
from adapter.records import Array, StateLayout
from drivers.interface import Driver, DriverError, EndOfStream, JointSample

DURATION, INTERRUPTED = "duration", "interrupted"
DRIVER_ERROR, END_OF_STREAM = "driver_error", "end_of_stream"
STOP_LIMIT_S = 5.0  # a safe stop that takes longer is left to the driver


class FrontEndLike(Protocol):
    """What turns samples into filtered states; `adapter.front_end.FrontEnd` for one."""

    layout: StateLayout

    def step(self, sample: JointSample) -> Array | None:
        """The filtered state that this sample completes, or None."""


class Session:
    """Ticks of one run.

    Args:
        driver: connected.
        front_end: takes the samples.
        controller: moves the arm; None listens.
        pass_on: takes each filtered state; it must copy what it keeps.
        keep: takes each sample and the command given upon it, if any.
        duration_s: of the arm's own stamps, until the safe stop begins; None for no end.

    Attributes:
        samples: read so far.
        elapsed_s: on the arm's own stamps.
        ended: why the run came to its end, one of the four constants above.
        fault: what the driver or the controller said, or None.
        began_ns, stepped_ns: instants (CLOCK_MONOTONIC) of the begin of the last tick's compute
            and of its filtered state.
    """

    def __init__(
        self,
        driver: Driver,
        front_end: FrontEndLike,
        controller: Controller | None,
        pass_on: Callable[[Array], None],
        keep: Callable[[JointSample, Array | None], None],
        duration_s: float | None,
    ) -> None:
        self._driver, self._front_end, self._controller = driver, front_end, controller
        self._pass_on, self._keep, self._duration_s = pass_on, keep, duration_s
        self.samples, self.elapsed_s = 0, 0.0
        self.ended = DURATION
        self.fault: str | None = None
        self.began_ns = self.stepped_ns = 0
        self._first_ns: int | None = None
        self._stopping_at_s: float | None = None
        self._ready_sample: JointSample | None = None

    def start_with(self, sample: JointSample) -> None:
        """Let the first tick take this sample, already read, instead of reading one."""
        self._ready_sample = sample

    def tick(self) -> bool:
        """Read, filter, pass on, control, record; false where the run has come to its end."""
        driver = self._driver
        self.began_ns = time.monotonic_ns()
        try:
            sample, self._ready_sample = self._ready_sample or driver.read(), None
        except EndOfStream as end:
            return self._end(END_OF_STREAM, str(end))
        except DriverError as error:
            return self._end(DRIVER_ERROR, str(error))
        if driver.paced:
            self.began_ns = time.monotonic_ns()  # until here it waited for the arm
        record = self._front_end.step(sample)
        self.stepped_ns = time.monotonic_ns()
        self.samples += 1
        if record is not None:
            self._pass_on(record)
        command, trouble = self._move(sample)
        self._keep(sample, command)
        if trouble is not None:
            return self._end(DRIVER_ERROR, trouble)
        return self._goes_on(sample.stamp_ns)

    def _move(self, sample: JointSample) -> tuple[Array | None, str | None]:
        if self._controller is None:
            return None, None
        try:
            tau = self._controller.step(sample)
            self._driver.command(tau)
        except (ControlError, DriverError) as error:
            return None, str(error)
        return tau, None

    def begin_stop(self, why: str) -> None:
        """Begin the safe stop; the run ends when the arm rests. Later calls change nothing."""
        if self._stopping_at_s is None:
            self._stopping_at_s, self.ended = self.elapsed_s, why
            if self._controller is not None:
                self._controller.begin_stop()

    def _goes_on(self, stamp_ns: int) -> bool:
        if self._first_ns is None:
            self._first_ns = stamp_ns
        self.elapsed_s = 1e-9 * (stamp_ns - self._first_ns)
        if self._duration_s is not None and self.elapsed_s >= self._duration_s:
            self.begin_stop(DURATION)
        if self._stopping_at_s is None:
            return True
        if self._controller is None or self._controller.at_rest:
            return False
        return self.elapsed_s < self._stopping_at_s + STOP_LIMIT_S

    def _end(self, why: str, fault: str) -> bool:
        self.ended, self.fault = why, None if why == END_OF_STREAM else fault
        return False


def stop_arm(driver: Driver, session: Session | None) -> None:
    """Let the driver bring the arm to a stand; a failure to do so is told as the fault."""
    try:
        driver.stop()
    except DriverError as error:
        if session is not None and session.fault is None:
            session.ended, session.fault = DRIVER_ERROR, str(error)
