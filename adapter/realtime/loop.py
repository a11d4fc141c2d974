"""The live process: a clock, a driver, the front end; everything slow happens elsewhere."""

from __future__ import annotations

import copy
import os
import select
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from adapter.control.controller import ExcitationController
from adapter.realtime.following import FollowingObserver
from adapter.realtime.jobs import Jobs
from adapter.realtime.real_time import Clock, RealTime, split_cores
from adapter.realtime.session import Ended, Session, stop_arm
from adapter.realtime.supervisor import SharedMemoryOptions, Supervisor
from adapter.realtime.timing import Timing, TimingReport
from adapter.signals.front_end import FrontEnd
from drivers.interface import Driver, DriverError, Intake, JointSample
from drivers.process import StopSignals

WALL_SHARE, WALL_EXTRA_S = 1.1, 2.0  # a run whose stamps stand still ends by the clock on the wall
WARM_UP_REACH, WARM_UP_RATE = 0.02, 10.0  # rad, rad/s


@dataclass(frozen=True)
class LiveOptions:
    """How a live run goes.

    Attributes:
        duration_s: until the safe stop begins; None runs until somebody stops it.
        deadman: stop safely as well when the operator's terminal or the parent process is gone.
        shared_memory: sizes and names.
        before_motion: called once the motion is drawn (the controller knows it) and before the
            first command, with what says whether somebody asked to stop; what it raises ends the
            run with the arm at rest.
        observer: says what pushes the arm; None where nobody wants to know.
    """

    duration_s: float | None = None
    deadman: bool = False
    shared_memory: SharedMemoryOptions = field(default_factory=SharedMemoryOptions)
    before_motion: Callable[[Callable[[], bool]], None] | None = None
    observer: FollowingObserver | None = None


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
        ended: why.
        fault: what the driver or the controller said; None where all was well.
        timing: report.
        grants: what the operating system granted, a sentence each.
        collected: what the learner's `collect` gave; None without one, or where it died.
        troubles: workers that died or failed, one sentence each.
        tracking: of the controller, see `ExcitationController.tracking`; None in passive mode.
        intake: the driver's account.
        contacts: what pushed the arm, filled in by whoever knows the arm.
    """

    samples: int
    set_aside: int
    passed_on: int
    skipped: int
    unlearned: int
    restarts: int
    recorded: int | None
    unrecorded: int
    ended: Ended
    fault: str | None
    timing: TimingReport
    grants: list[str]
    collected: Any
    troubles: list[str]
    tracking: dict[str, Any] | None
    intake: Intake
    contacts: list[dict[str, Any]] = field(default_factory=list)


class Deadman:
    """Looks whether the operator is still there, some 2 µs a look.

    The operator is gone when the terminal was closed, or the program that started this one ended.
    Where standard input is no terminal (a service, a pipe), the parent process alone is watched.
    """

    def __init__(self) -> None:
        self._parent = os.getppid()
        self._poll: select.poll | None = None
        if os.isatty(0):
            self._poll = select.poll()
            self._poll.register(0, 0)  # a hang-up is told without being asked for

    def gone(self) -> bool:
        """Whether nobody is there to stop the arm any more."""
        if os.getppid() != self._parent:
            return True
        if self._poll is None:
            return False
        hung_up = select.POLLHUP | select.POLLERR | select.POLLNVAL
        return any(event & hung_up for _, event in self._poll.poll(0))


def run_live(
    driver: Driver,
    front_end: FrontEnd,
    controller: ExcitationController | None = None,
    jobs: Jobs | None = None,
    options: LiveOptions | None = None,
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
        jobs: of the workers.
        options: of the run.
        say: takes lines for people; called in the loop only when a worker died.

    Raises:
        DriverError: the arm cannot be reached or cannot move, or the recording cannot be
            written. What goes wrong later is told in the result.
        SharedMemoryError, SnapshotError, WorkerError: no memory, no workers.
        SettingsError: the arm cannot start from where it stands.
    """
    options, jobs = options or LiveOptions(), jobs or Jobs()
    if controller is not None and not driver.can_move:
        raise DriverError("this source cannot move; run it in passive mode")

    def tell(line: str) -> None:
        with suppress(OSError):  # a terminal that is gone is no reason to drop an arm
            say(line)

    deadman = Deadman() if options.deadman else None
    with ExitStack() as stack:
        stop = stack.enter_context(StopSignals())
        size = front_end.layout.size
        supervisor = Supervisor(driver, size, jobs, options.shared_memory, tell)
        stack.callback(supervisor.close)
        supervisor.start(cancelled=lambda: stop.count > 0)
        stack.callback(driver.close)
        driver.connect()
        real_time = RealTime(min(split_cores()[0]))
        session = None
        try:
            session = Session(
                driver,
                front_end,
                controller,
                supervisor.pass_on,
                supervisor.keep,
                options.duration_s,
            )
            session.observer = observer = options.observer
            if observer is not None and supervisor.board is not None:
                observer.attach(supervisor.board.name)
            loop = _Loop(driver, session, supervisor, stop, deadman)
            _prepare(driver, front_end, controller, supervisor, session)
            if options.before_motion is not None:
                options.before_motion(lambda: stop.count > 0)
            with real_time:
                for grant in real_time.grants:
                    tell(grant)
                session.catch_up()
                try:
                    loop.run(options.duration_s)
                finally:  # at once: an arm that hears nothing for 20 ms trips
                    stop_arm(driver, session)
        finally:
            stop_arm(driver, session)
            if controller is not None:
                controller.detach()
            if options.observer is not None:
                options.observer.detach()
            if session is not None and supervisor.loop_board is not None:
                supervisor.loop_board.write_end(session.ended, session.fault)
            collected = supervisor.finish(hurry=lambda: stop.count > 2)
        return loop.result(real_time.grants, collected)


def _prepare(
    driver: Driver,
    front_end: FrontEnd,
    controller: ExcitationController | None,
    supervisor: Supervisor,
    session: Session,
) -> None:
    """All that takes long and only once: compile, draw the motion, attach the estimate."""
    if controller is not None and supervisor.board is not None:
        controller.attach(supervisor.board.name)

    def prepare(sample: JointSample) -> None:
        if controller is not None:
            controller.prepare(sample)

    sample = session.get_ready(prepare)
    shown = copy.deepcopy(front_end)  # some motion around this sample, so that all is compiled
    for k in range(1, 500):  # ticks of made-up motion
        angle = WARM_UP_RATE * 1e-9 * driver.period_ns * k
        q = sample.q + WARM_UP_REACH * np.sin(angle)
        dq = np.full(q.shape, WARM_UP_REACH * WARM_UP_RATE * np.cos(angle))
        stamp_ns = sample.stamp_ns + k * driver.period_ns
        shown.step(replace(sample, stamp_ns=stamp_ns, q=q, dq=dq))
    if driver.paced:  # time went by; what was read first may be far behind
        session.get_ready(prepare)


class _Loop:
    """The ticks of a run, each at its time."""

    def __init__(
        self,
        driver: Driver,
        session: Session,
        supervisor: Supervisor,
        stop: StopSignals,
        deadman: Deadman | None,
    ) -> None:
        self._driver, self._session, self._supervisor = driver, session, supervisor
        self._stop, self._deadman = stop, deadman
        board = supervisor.loop_board
        self._clock = Clock(driver.period_ns)
        self._timing = Timing(None if board is None else board.bins)

    def run(self, duration_s: float | None) -> None:
        """Tick until the session has come to its end, or somebody has no patience."""
        driver, session, stop = self._driver, self._session, self._stop
        begin, ticks = time.monotonic(), 0
        wall_s = None if duration_s is None else WALL_SHARE * duration_s + WALL_EXTRA_S
        goes_on = True
        while goes_on and stop.count < 2:
            if not driver.paced:
                self._timing.late(self._clock.wait())
            samples = session.samples
            goes_on = session.tick()
            if session.samples > samples:
                plant_ns = getattr(driver, "plant_time_ns", 0) if ticks else 0
                age_ns = session.had_ns - driver.arrived_ns if driver.arrived_ns else None
                if driver.paced:
                    self._clock.follow(session.began_ns)
                ended_ns = time.monotonic_ns()
                self._timing.add(session.began_ns, session.stepped_ns, ended_ns, plant_ns, age_ns)
            ticks += 1
            if stop.count:
                session.begin_stop(Ended.INTERRUPTED)
            if ticks % 256 == 0:  # a look at the workers takes its time
                self._supervisor.look_after()
                if self._supervisor.loop_board is not None:
                    missed = self._clock.missed, self._clock.missed_own
                    self._supervisor.loop_board.count_missed(*missed)
                if self._deadman is not None and self._deadman.gone():
                    session.begin_stop(Ended.OPERATOR_GONE)
                if wall_s is not None and time.monotonic() - begin > wall_s:
                    session.begin_stop(Ended.DURATION)
        if stop.count > 1:
            session.begin_stop(Ended.INTERRUPTED)

    def result(self, grants: list[str], collected: Any) -> LiveResult:
        """What became of the run."""
        session, supervisor = self._session, self._supervisor
        counted = "passed_on", "skipped", "unlearned", "restarts", "recorded", "unrecorded"
        return LiveResult(
            samples=session.samples,
            set_aside=session.set_aside,
            **{key: getattr(supervisor, key) for key in counted},
            ended=session.ended,
            fault=session.fault,
            timing=self._timing.report(self._clock.missed, self._clock.missed_own),
            grants=grants,
            collected=collected,
            troubles=supervisor.troubles,
            tracking=session.tracking,
            intake=copy.deepcopy(self._driver.intake),
        )
