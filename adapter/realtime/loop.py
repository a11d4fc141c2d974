"""The live process: a clock, a driver, the front end; everything slow happens elsewhere."""

from __future__ import annotations

import copy
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from types import FrameType, TracebackType
from typing import Any

import numpy as np

from adapter.controller import Controller
from adapter.realtime.clock import Clock
from adapter.realtime.crew import Crew, CrewOptions
from adapter.realtime.deadman import Deadman
from adapter.realtime.jobs import LearnerJob, RecordingJob, WatchJob
from adapter.realtime.rt import DEFAULT_PRIORITY, Grant, RealTime, split_cores
from adapter.realtime.session import (
    DURATION,
    INTERRUPTED,
    OPERATOR_GONE,
    FrontEndLike,
    Session,
    stop_arm,
)
from adapter.realtime.timing import Timing, TimingReport
from drivers.interface import Driver, DriverError, Intake, JointSample

LOOK_EVERY = 256  # ticks between two looks at the workers
WALL_SHARE, WALL_EXTRA_S = 1.1, 2.0  # a run whose stamps stand still ends by the clock on the wall
WARM_UP_TICKS = 500  # of made-up motion, for the compiler
WARM_UP_REACH, WARM_UP_RATE = 0.02, 10.0  # rad, rad/s


@dataclass(frozen=True)
class LiveOptions:
    """How a live run goes.

    Attributes:
        duration_s: until the safe stop begins; None runs until somebody stops it.
        priority: of SCHED_FIFO; None stays ordinary.
        lock_memory: whether to ask for it.
        deadman: stop safely as well when the operator's terminal or the parent process is gone.
        crew: sizes and names of shared memory.
    """

    duration_s: float | None = None
    priority: int | None = DEFAULT_PRIORITY
    lock_memory: bool = True
    deadman: bool = False
    crew: CrewOptions = field(default_factory=CrewOptions)


@dataclass(frozen=True)
class LiveResult:
    """What a live run did.

    Attributes:
        samples: read from the arm and taken.
        set_aside: read from the arm to get ready, before the first of these.
        passed_on: filtered states handed to the learner, which learned from all of them unless
            `troubles` says otherwise.
        skipped: of these, not learned because the ring had lost them when a learner died.
        unlearned: filtered states without a learner: it had died, or its ring was full.
        restarts: learners and recorders that followed one that died.
        recorded: samples in files; None without a recorder.
        unrecorded: the other samples: the recorder's ring had no room, or there was none.
        ended: "duration", "interrupted", "operator_gone", "driver_error" or "end_of_stream".
        fault: what the driver or the controller said; None where all was well.
        timing: report.
        grants: what the operating system granted.
        collected: what the learner's `collect` gave; None without one, or where it died.
        troubles: workers that died or failed, one sentence each.
        tracking: of the controller, see `Controller.tracking`; None in passive mode.
        intake: the driver's account.
    """

    samples: int
    set_aside: int
    passed_on: int
    skipped: int
    unlearned: int
    restarts: int
    recorded: int | None
    unrecorded: int
    ended: str
    fault: str | None
    timing: TimingReport
    grants: list[Grant]
    collected: Any
    troubles: list[str]
    tracking: dict[str, Any] | None
    intake: Intake


class StopSignals:
    """Counts SIGINT, SIGTERM and SIGHUP in place of their usual effect (main thread only).

    A SIGHUP that is ignored (`nohup`) stays so.
    """

    def __init__(self) -> None:
        self.count = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN:
                    continue
                self._before[number] = signal.signal(number, self._hear)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        self.count += 1


def run_live(
    driver: Driver,
    front_end: FrontEndLike,
    *,
    controller: Controller | None = None,
    learner: LearnerJob | None = None,
    recording: RecordingJob | None = None,
    watch: WatchJob | None = None,
    options: LiveOptions | None = None,
    before_motion: Callable[[], None] | None = None,
    say: Callable[[str], None] = print,
) -> LiveResult:
    """Run an arm live until the duration is over, somebody stops it or the driver fails.

    However it ends, the arm is stopped, the rings are drained and the files closed: also by an
    error in a tick, which is raised after that. SIGINT, SIGTERM and SIGHUP ask for the safe stop;
    a second one ends the run at once with the driver's stop; a third one no longer waits for the
    learner.

    Args:
        driver: not connected yet; closed at the end.
        front_end: fresh; takes the samples.
        controller: moves the arm; None only listens.
        learner, recording, watch: jobs of the workers; None leaves them out.
        options: of the run.
        before_motion: called once the motion is drawn (`controller` knows it) and before the
            first command; what it raises ends the run with the arm at rest.
        say: takes lines for people; called in the loop only when a worker died.

    Raises:
        DriverError: the arm cannot be reached or cannot move, or the recording cannot be
            written. What goes wrong later is told in the result.
        SharedMemoryError, SnapshotError, WorkerError: no memory, no workers.
        SettingsError: the arm cannot start from where it stands.
    """
    options = options or LiveOptions()
    if controller is not None and not driver.can_move:
        raise DriverError("this source cannot move; run it in passive mode")
    tell = _without_fail(say)
    watchman = Deadman() if options.deadman else None
    with ExitStack() as stack:
        stop = stack.enter_context(StopSignals())
        crew = Crew(driver, front_end.layout.size, learner, recording, watch, options.crew, tell)
        stack.callback(crew.close)
        crew.start(cancelled=lambda: stop.count > 0)
        stack.callback(driver.close)
        driver.connect()
        clock, timing = Clock(driver.period_ns), Timing()
        real_time = RealTime(min(split_cores()[0]), options.priority, options.lock_memory)
        session = None
        try:
            session = Session(
                driver, front_end, controller, crew.pass_on, crew.keep, options.duration_s
            )
            _prepare(driver, front_end, controller, crew, session)
            if before_motion is not None:
                before_motion()
            with real_time:
                for grant in real_time.grants:
                    tell(grant.line)
                session.catch_up()
                try:
                    _loop(driver, session, crew, stop, watchman, clock, timing, options.duration_s)
                finally:  # at once: an arm that hears nothing for 20 ms trips
                    stop_arm(driver, session)
        finally:
            stop_arm(driver, session)
            if controller is not None:
                controller.detach()
            collected = crew.finish(hurry=lambda: stop.count > 2)
        return LiveResult(
            samples=session.samples,
            set_aside=session.set_aside,
            passed_on=crew.passed_on,
            skipped=crew.skipped,
            unlearned=crew.unlearned,
            restarts=crew.restarts,
            recorded=crew.recorded,
            unrecorded=crew.unrecorded,
            ended=session.ended,
            fault=session.fault,
            timing=timing.report(clock.missed, clock.missed_own),
            grants=real_time.grants,
            collected=collected,
            troubles=crew.troubles,
            tracking=None if controller is None else controller.tracking(),
            intake=copy.deepcopy(driver.intake),
        )


def _without_fail(say: Callable[[str], None]) -> Callable[[str], None]:
    """The same, but for a terminal that is gone: no reason to drop an arm."""

    def tell(line: str) -> None:
        with suppress(OSError):
            say(line)

    return tell


def _prepare(
    driver: Driver,
    front_end: FrontEndLike,
    controller: Controller | None,
    crew: Crew,
    session: Session,
) -> None:
    """All that takes long and only once: compile, draw the motion, attach the estimate."""
    if controller is not None and crew.board is not None:
        controller.attach(crew.board.name)

    def prepare(sample: JointSample) -> None:
        if controller is not None:
            controller.prepare(sample)

    sample = session.get_ready(prepare)
    _warm_up(copy.deepcopy(front_end), sample, driver.period_ns)
    if driver.paced:  # time went by; what was read first may be far behind
        session.get_ready(prepare)


def _warm_up(front_end: FrontEndLike, sample: JointSample, period_ns: int) -> None:
    """Show a copy of the front end some motion around this sample, so that all is compiled."""
    for k in range(1, WARM_UP_TICKS):
        angle = WARM_UP_RATE * 1e-9 * period_ns * k
        q = sample.q + WARM_UP_REACH * np.sin(angle)
        dq = np.full(q.shape, WARM_UP_REACH * WARM_UP_RATE * np.cos(angle))
        stamp_ns = sample.stamp_ns + k * period_ns
        front_end.step(replace(sample, stamp_ns=stamp_ns, q=q, dq=dq))


def _loop(
    driver: Driver,
    session: Session,
    crew: Crew,
    stop: StopSignals,
    watchman: Deadman | None,
    clock: Clock,
    timing: Timing,
    duration_s: float | None,
) -> None:
    begin, ticks = time.monotonic(), 0
    wall_s = None if duration_s is None else WALL_SHARE * duration_s + WALL_EXTRA_S
    goes_on = True
    while goes_on and stop.count < 2:
        if not driver.paced:
            timing.late(clock.wait())
        samples = session.samples
        goes_on = session.tick()
        if session.samples > samples:
            plant_ns = getattr(driver, "plant_time_ns", 0) if ticks else 0
            age_ns = session.had_ns - driver.arrived_ns if driver.arrived_ns else None
            ended_ns = time.monotonic_ns()
            timing.add(session.began_ns, session.stepped_ns, ended_ns, plant_ns, age_ns)
        ticks += 1
        if stop.count:
            session.begin_stop(INTERRUPTED)
        if ticks % LOOK_EVERY == 0:
            crew.look_after()
            if watchman is not None and watchman.gone():
                session.begin_stop(OPERATOR_GONE)
            if wall_s is not None and time.monotonic() - begin > wall_s:
                session.begin_stop(DURATION)
    if stop.count > 1:
        session.begin_stop(INTERRUPTED)
