"""Rings, the estimate's board and the workers of one live run, from start to end."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from adapter.model.spatial import Array
from adapter.realtime.jobs import Jobs, LearnerJob, LearnerTask, RecorderTask, RecordingJob
from adapter.realtime.real_time import split_cores
from adapter.realtime.ring import RawLayout, Ring, affordable_rows
from adapter.realtime.shared import SharedMemoryError
from adapter.realtime.showing import DisplayTask
from adapter.realtime.snapshot import DEFAULT_NAME, SnapshotError, SnapshotWriter
from adapter.realtime.timing import LoopBoard
from adapter.realtime.worker import RESTARTS, RestartableWorker, Worker, WorkerError, worker_starter
from drivers.interface import Driver, JointSample

SHORTEST_RING_S = 1.0
RECORDER_NICE, DISPLAY_NICE = 5, 10
DISPLAY_STALL_S = 3.0


@dataclass(frozen=True)
class SharedMemoryOptions:
    """Sizes and names.

    Attributes:
        ring_s: how much the rings hold; less where shared memory is short (it is said).
        snapshot_name: under which other processes find the estimate, if it is free; None for any.
    """

    ring_s: float = 60.0
    snapshot_name: str | None = DEFAULT_NAME


class Supervisor:
    """Workers and what connects them with the loop. A worker that dies never stops the loop.

    A learner that dies is followed by one that goes on from its last kept state with what the
    ring holds since; a recorder that dies by one that writes a further file. Three times each.

    Args:
        driver: for the names of joints and links and the period.
        state_size: of a filtered state's record.
        jobs: what to do.
        options: sizes and names.
        say: takes a line for people.

    Attributes:
        passed_on: states handed to the learner; unlearned: those that found no room or nobody.
        skipped: of those passed on, not learned because the ring had lost them when the learner
            died, known at the end.
        kept: samples that were to be recorded; recorded: of these, in files, known at the end.
        troubles: one sentence for each worker that died.
        loop_board: what the loop says of itself; None where nobody looks.
    """

    def __init__(
        self,
        driver: Driver,
        state_size: int,
        jobs: Jobs,
        options: SharedMemoryOptions,
        say: Callable[[str], None],
    ) -> None:
        self._say, self._jobs = say, jobs
        self._names = tuple(driver.joint_names), tuple(driver.link_names)
        self.raw = RawLayout(len(self._names[0]), len(self._names[1]))
        self._record = np.zeros(self.raw.size)
        self._state_size, self._period_ns, self._options = state_size, driver.period_ns, options
        self._cores = split_cores()[1]
        self._starter: ThreadPoolExecutor | None = None
        self._folder: Path | None = None
        self.states: Ring | None = None
        self.samples: Ring | None = None
        self.board: SnapshotWriter | None = None
        self.learner: RestartableWorker | None = None
        self.recorder: RestartableWorker | None = None
        self.display: Worker | None = None
        self.view: RestartableWorker | None = None
        self.loop_board: LoopBoard | None = None
        self.passed_on = self.unlearned = self.kept = self.skipped = 0
        self.recorded: int | None = None
        self.troubles: list[str] = []

    def start(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Create memory and processes and wait until all are ready, or it is cancelled.

        Raises:
            DriverError: the recording cannot be written.
            SharedMemoryError, SnapshotError, WorkerError: as they say.
        """
        jobs, rows = self._jobs, self._rows()
        self._starter = worker_starter(self._cores)
        if jobs.learner is not None:
            self.states = Ring.create(self._state_size, rows)
            self.board = self._new_board(jobs.learner)
            lasting = jobs.learner.keep is not None and jobs.learner.restore is not None
            if lasting:
                self._folder = Path(tempfile.mkdtemp(prefix="adapter-learner-"))
            task = LearnerTask(jobs.learner, self.states.name, self.board.name, self._folder)
            name = "learner process"
            most, lost = RESTARTS if lasting else 0, "nothing more is learned"
            self.learner = self._restartable(
                name, lambda k: Worker(name, task, self._cores), most, lost
            )
        board = None if self.board is None else self.board.name
        if jobs.recording or jobs.display or jobs.view:
            self.loop_board = LoopBoard.create()
        if jobs.recording is not None:
            self.samples = Ring.create(self.raw.size, rows)
            self.recorder = self._start_recorder(jobs.recording, self.samples, board)
        self._start_displays(board)
        first = [part.worker for part in (self.recorder, self.learner) if part is not None]
        for worker in (*first, self.display):
            if worker is not None:
                worker.wait_ready(cancelled=cancelled)
        if self.view is None or self.view.worker is None:
            return
        try:  # a run does without one that cannot show
            self.view.worker.wait_ready(cancelled=cancelled)
        except WorkerError as error:
            if cancelled():
                raise
            self.view.kill()
            self.view = None
            self._tell(f"{error}; the arm goes on, nothing is shown")

    def _start_displays(self, board: str | None) -> None:
        jobs, shown = self._jobs, self.states or self.samples
        if shown is None or self.loop_board is None:
            return
        names = shown.name, board, self.loop_board.name
        if jobs.display is not None:
            show = DisplayTask(jobs.display, *names)
            self.display = Worker("display process", show, self._cores, DISPLAY_NICE)
        if jobs.view is not None:
            name, task = "view process", DisplayTask(jobs.view, *names)
            build = partial(Worker, name, task, self._cores)
            lost = "nothing more is shown"
            self.view = self._restartable(name, lambda k: build(), RESTARTS, lost)

    def _start_recorder(
        self, job: RecordingJob, ring: Ring, board: str | None
    ) -> RestartableWorker:
        name = "recorder process"
        loop = None if self.loop_board is None else self.loop_board.name

        def build(k: int) -> Worker:
            task = RecorderTask(job.part(k), ring.name, board, loop, *self._names)
            return Worker(name, task, self._cores, RECORDER_NICE)

        return self._restartable(name, build, RESTARTS, "nothing more is recorded")

    def _restartable(
        self, name: str, build: Callable[[int], Worker], most: int, lost: str
    ) -> RestartableWorker:
        assert self._starter is not None
        lost = f"the arm goes on, {lost}"
        return RestartableWorker(name, build, self._starter, most, self._tell, lost)

    @property
    def restarts(self) -> int:
        """Learners and recorders that followed one that died."""
        return sum(part.restarts for part in (self.learner, self.recorder) if part is not None)

    @property
    def unrecorded(self) -> int:
        """Samples that are in no file, known at the end."""
        return 0 if self.recorded is None else self.kept - self.recorded

    def _new_board(self, learner: LearnerJob) -> SnapshotWriter:
        """Where the estimate is published; under another name where another run has the usual."""
        parts, name = (self._names[0], learner.effect_names), self._options.snapshot_name
        try:
            return SnapshotWriter.create(*parts, name=name)
        except SnapshotError as error:
            if name is None:
                raise
            board = SnapshotWriter.create(*parts, name=None)
            self._say(f"{error}; this run publishes its estimate as '{board.name}'")
            return board

    def _rows(self) -> int:
        """Records that each ring can hold. Raises SharedMemoryError where these are too few."""
        wanted, fewest = (
            max(round(1e9 * seconds / self._period_ns), 1)
            for seconds in (self._options.ring_s, SHORTEST_RING_S)
        )
        jobs = self._jobs
        rings = (self._state_size, jobs.learner), (self.raw.size, jobs.recording)
        rows = affordable_rows(tuple(size for size, job in rings if job is not None), wanted)
        if rows < fewest:
            raise SharedMemoryError(
                f"shared memory is too small for rings of {SHORTEST_RING_S} s; give it more "
                "(docker run --shm-size=256m)"
            )
        if rows < wanted:
            self._say(
                f"shared memory is short: rings hold {rows} samples instead of "
                f"{wanted} (docker run --shm-size=256m gives more)"
            )
        return rows

    def pass_on(self, record: Array) -> None:
        """Hand a filtered state to the learner; never waits."""
        if self.learner is None or self.states is None:
            return
        if not self.passed_on and self.loop_board is not None:
            self.loop_board.write_begin(int(record[:1].view(np.int64)[0]))
        if self.learner.held and self.states.push(record):
            self.passed_on += 1
        else:
            self.unlearned += 1

    def keep(
        self, sample: JointSample, command: Array | None, external: Array | None = None
    ) -> None:
        """Hand a sample to the recorder; never waits."""
        if self.recorder is None or self.samples is None:
            return
        self.kept += 1
        if self.recorder.held:
            self.raw.fill(self._record, sample, command, external)
            self.samples.push(self._record)

    def look_after(self) -> None:
        """Notice workers that died, tell it once and have them followed; never waits."""
        for worker, ring in ((self.learner, self.states), (self.recorder, self.samples)):
            if worker is not None and ring is not None and worker.held:
                worker.look_after()
                if not worker.held:
                    self._abandon(ring)
        if self.view is not None and self.view.held:
            self.view.look_after()

    def _tell(self, line: str) -> None:
        """Say a line, or let the display do so where it is there and says lines itself."""
        self.troubles.append(line)
        job, shown, board = self._jobs.display, self.display, self.loop_board
        says = job is not None and job.says and shown is not None and shown.alive
        if not (says and board is not None and board.write_line(line)):
            self._say(line)

    def _abandon(self, ring: Ring) -> None:
        """Empty the ring that nobody reads any more, which a display may be waiting for."""
        if ring is self.samples:
            self.recorded = ring.released
        ring.release(ring.unread)

    def finish(self, hurry: Callable[[], bool]) -> Any:
        """Let the workers drain their rings and end; returns what the learner collected.

        Args:
            hurry: true when somebody no longer wants to wait for the learner.
        """
        for ring in (self.states, self.samples):
            if ring is not None:
                ring.finish()
        learner = self._end(self.learner, self.states, hurry)
        recorder = self._end(self.recorder, self.samples, lambda: False)
        if recorder is not None and self.samples is not None:
            self.recorded = self.samples.released
        if self.states is not None:
            self.skipped = self.states.skipped
        if self.display is not None:
            self.display.finish(lambda: 0, stall_s=DISPLAY_STALL_S)
        if self.view is not None and self.view.held:
            latest = time.monotonic() + 4.0  # at the end, for browsers to hear of it
            self.view.finish(lambda: 0, hurry=lambda: time.monotonic() > latest)
        return None if learner is None else learner.result

    def _end(
        self, worker: RestartableWorker | None, ring: Ring | None, hurry: Callable[[], bool]
    ) -> Worker | None:
        """The worker that drained its ring and came to its end; None where none did."""
        if worker is None or ring is None or not worker.held:
            return None
        last = worker.finish(lambda: ring.taken, hurry)
        if last is None:
            self._abandon(ring)
        return last

    def close(self) -> None:
        """End what still runs and free all memory; may be called more than once."""
        if self._starter is not None:
            self._starter.shutdown()
        for worker in (self.learner, self.recorder, self.display, self.view):
            if worker is not None:
                worker.kill()
        for part in (self.states, self.samples, self.board, self.loop_board):
            if part is not None:
                part.close()
                part.unlink()
        self.states = self.samples = self.board = self.loop_board = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
