"""Rings, the estimate's board and the workers of one live run, from start to end."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapter.realtime.bodies import RecorderBody, WatchBody
from adapter.realtime.jobs import LearnerJob, RecordingJob, WatchJob
from adapter.realtime.learner_body import LearnerBody
from adapter.realtime.nurse import Nurse
from adapter.realtime.post import RESTARTS, Post
from adapter.realtime.raw import RawLayout
from adapter.realtime.ring import Ring, affordable_rows
from adapter.realtime.rt import split_cores
from adapter.realtime.shared import SharedMemoryError
from adapter.realtime.snapshot import DEFAULT_NAME, SnapshotError, SnapshotWriter
from adapter.realtime.worker import Worker
from adapter.records import Array
from drivers.interface import Driver, JointSample

SHORTEST_RING_S = 1.0
RECORDER_NICE, WATCH_NICE = 5, 10
WATCH_STALL_S = 3.0


@dataclass(frozen=True)
class CrewOptions:
    """Sizes and names.

    Attributes:
        ring_s: how much the rings hold; less where shared memory is short (it is said).
        snapshot_name: under which other processes find the estimate, if it is free; None for any.
    """

    ring_s: float = 60.0
    snapshot_name: str | None = DEFAULT_NAME


class Crew:
    """Workers and what connects them with the loop. A worker that dies never stops the loop.

    A learner that dies is followed by one that goes on from its last kept state with what the
    ring holds since; a recorder that dies by one that writes a further file. Three times each.

    Args:
        driver: for the names of joints and links and the period.
        state_size: of a filtered state's record.
        learner, recording, watch: what to do; None leaves it.
        options: sizes and names.
        say: takes a line for people.

    Attributes:
        passed_on: states handed to the learner; unlearned: those that found no room or nobody.
        skipped: of those passed on, not learned because the ring had lost them when the learner
            died, known at the end.
        kept: samples that were to be recorded; recorded: of these, in files, known at the end.
        troubles: one sentence for each worker that died.
    """

    def __init__(
        self,
        driver: Driver,
        state_size: int,
        learner: LearnerJob | None,
        recording: RecordingJob | None,
        watch: WatchJob | None,
        options: CrewOptions,
        say: Callable[[str], None],
    ) -> None:
        self._say = say
        self._jobs = learner, recording, watch
        self._names = tuple(driver.joint_names), tuple(driver.link_names)
        self.raw = RawLayout(len(self._names[0]), len(self._names[1]))
        self._record = self.raw.new()
        self._sizes = state_size, self.raw.size
        self._wanted_rows = max(round(options.ring_s * 1e9 / driver.period_ns), 1)
        self._fewest_rows = max(round(SHORTEST_RING_S * 1e9 / driver.period_ns), 1)
        self._snapshot_name = options.snapshot_name
        self._cores = split_cores()[1]
        self._nurse: Nurse | None = None
        self._folder: Path | None = None
        self.states: Ring | None = None
        self.samples: Ring | None = None
        self.board: SnapshotWriter | None = None
        self.learner: Post | None = None
        self.recorder: Post | None = None
        self.watcher: Worker | None = None
        self.passed_on = self.unlearned = self.kept = 0
        self.recorded: int | None = None
        self.skipped = 0
        self._result: Any = None
        self.troubles: list[str] = []

    def start(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Create memory and processes and wait until all are ready, or it is cancelled.

        Raises:
            DriverError: the recording cannot be written.
            SharedMemoryError, SnapshotError, WorkerError: as they say.
        """
        learner, recording, watch = self._jobs
        rows = self._rows(learner is not None, recording is not None)
        self._nurse = Nurse(self._cores)
        if learner is not None:
            self.states = Ring.create(self._sizes[0], rows)
            self.board = self._new_board(learner)
            self._hire_learner(learner, self.states, self.board.name)
        board = None if self.board is None else self.board.name
        if recording is not None:
            self.samples = Ring.create(self._sizes[1], rows)
            self._hire_recorder(recording, self.samples, board)
        shown = self.states or self.samples
        if watch is not None and shown is not None:
            show = WatchBody(watch, shown.name, board)
            self.watcher = Worker("display process", show, self._cores, WATCH_NICE)
        posts = (post.worker for post in (self.recorder, self.learner) if post is not None)
        for worker in (*posts, self.watcher):
            if worker is not None:
                worker.wait_ready(cancelled=cancelled)

    def _hire_learner(self, job: LearnerJob, ring: Ring, board: str) -> None:
        lasting = job.keep is not None and job.restore is not None
        if lasting:
            self._folder = Path(tempfile.mkdtemp(prefix="adapter-learner-"))
        body = LearnerBody(job, ring.name, board, self._folder)
        assert self._nurse is not None
        self.learner = Post(
            "learner process",
            lambda k: Worker("learner process", body, self._cores),
            self._nurse,
            RESTARTS if lasting else 0,
            self._tell,
            "the arm goes on, nothing more is learned",
        )

    def _hire_recorder(self, job: RecordingJob, ring: Ring, board: str | None) -> None:
        def build(k: int) -> Worker:
            body = RecorderBody(job.part(k), ring.name, board, *self._names)
            return Worker("recorder process", body, self._cores, RECORDER_NICE)

        assert self._nurse is not None
        self.recorder = Post(
            "recorder process",
            build,
            self._nurse,
            RESTARTS,
            self._tell,
            "the arm goes on, nothing more is recorded",
        )

    @property
    def restarts(self) -> int:
        """Learners and recorders that followed one that died."""
        return sum(post.restarts for post in (self.learner, self.recorder) if post is not None)

    @property
    def unrecorded(self) -> int:
        """Samples that are in no file, known at the end."""
        return 0 if self.recorded is None else self.kept - self.recorded

    def _new_board(self, learner: LearnerJob) -> SnapshotWriter:
        """Where the estimate is published; under another name where another run has the usual."""
        parts = self._names[0], learner.effect_names, learner.bodies
        try:
            return SnapshotWriter.create(*parts, self._snapshot_name)
        except SnapshotError as error:
            if self._snapshot_name is None:
                raise
            board = SnapshotWriter.create(*parts, None)
            self._say(f"{error}; this run publishes its estimate as '{board.name}'")
            return board

    def _rows(self, learning: bool, recording: bool) -> int:
        sizes = tuple(s for s, on in zip(self._sizes, (learning, recording), strict=True) if on)
        rows = affordable_rows(sizes, self._wanted_rows)
        if rows < self._fewest_rows:
            raise SharedMemoryError(
                f"shared memory is too small for rings of {SHORTEST_RING_S} s; give it more "
                "(docker run --shm-size=256m)"
            )
        if rows < self._wanted_rows:
            self._say(
                f"shared memory is short: rings hold {rows} samples instead of "
                f"{self._wanted_rows} (docker run --shm-size=256m gives more)"
            )
        return rows

    def pass_on(self, record: Array) -> None:
        """Hand a filtered state to the learner; never waits."""
        if self.learner is None or self.states is None:
            return
        if self.learner.held and self.states.push(record):
            self.passed_on += 1
        else:
            self.unlearned += 1

    def keep(self, sample: JointSample, command: Array | None) -> None:
        """Hand a sample to the recorder; never waits."""
        if self.recorder is None or self.samples is None:
            return
        self.kept += 1
        if self.recorder.held:
            self.raw.fill(self._record, sample, command)
            self.samples.push(self._record)

    def look_after(self) -> None:
        """Notice workers that died, tell it once and have them followed; never waits."""
        for post, ring in ((self.learner, self.states), (self.recorder, self.samples)):
            if post is not None and ring is not None and post.held:
                post.look_after()
                if not post.held:
                    self._abandon(ring)

    def _tell(self, line: str) -> None:
        self.troubles.append(line)
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
        collected = None
        if self.states is not None and self._end(self.learner, self.states, hurry):
            collected = self._result
        if self.samples is not None and self._end(self.recorder, self.samples, lambda: False):
            self.recorded = self.samples.released
        if self.states is not None:
            self.skipped = self.states.skipped
        if self.watcher is not None:
            self.watcher.finish(lambda: 0, stall_s=WATCH_STALL_S)
        return collected

    def _end(self, post: Post | None, ring: Ring, hurry: Callable[[], bool]) -> bool:
        """Whether a worker came to its end; its result is in `_result`."""
        if post is None or not post.held:
            return False
        worker = post.finish(lambda: ring.taken, hurry)
        if worker is None:
            self._abandon(ring)
            return False
        self._result = worker.result
        return True

    def close(self) -> None:
        """End what still runs and free all memory; may be called more than once."""
        if self._nurse is not None:
            self._nurse.close()
        for post in (self.learner, self.recorder, self.watcher):
            if post is not None:
                post.kill()
        for part in (self.states, self.samples, self.board):
            if part is not None:
                part.close()
                part.unlink()
        self.states = self.samples = self.board = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
