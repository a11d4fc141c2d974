"""Rings, the estimate's board and the workers of one live run, from start to end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from adapter.realtime.bodies import LearnerBody, RecorderBody, WatchBody
from adapter.realtime.jobs import LearnerJob, RecordingJob, WatchJob
from adapter.realtime.raw import RawLayout
from adapter.realtime.ring import Ring, affordable_rows
from adapter.realtime.rt import split_cores
from adapter.realtime.shared import SharedMemoryError
from adapter.realtime.snapshot import DEFAULT_NAME, SnapshotWriter
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
        snapshot_name: under which other processes find the estimate; None for any free name.
    """

    ring_s: float = 60.0
    snapshot_name: str | None = DEFAULT_NAME


class Crew:
    """Workers and what connects them with the loop. A worker that dies never stops the loop.

    Args:
        driver: for the names of joints and links and the period.
        state_size: of a filtered state's record.
        learner, recording, watch: what to do; None leaves it.
        options: sizes and names.
        say: takes a line for people.
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
        self.states: Ring | None = None
        self.samples: Ring | None = None
        self.board: SnapshotWriter | None = None
        self.learner: Worker | None = None
        self.recorder: Worker | None = None
        self.watcher: Worker | None = None
        self.passed_on = self.unlearned = self.unrecorded = 0
        self.troubles: list[str] = []

    def start(self, cancelled: Callable[[], bool] = lambda: False) -> None:
        """Create memory and processes and wait until all are ready, or it is cancelled.

        Raises:
            DriverError: the recording cannot be written.
            SharedMemoryError, SnapshotError, WorkerError: as they say.
        """
        learner, recording, watch = self._jobs
        rows = self._rows(learner is not None, recording is not None)
        board = None
        if learner is not None:
            self.states = Ring.create(self._sizes[0], rows)
            self.board = SnapshotWriter.create(
                self._names[0], learner.effect_names, learner.bodies, self._snapshot_name
            )
            board = self.board.name
        if recording is not None:
            self.samples = Ring.create(self._sizes[1], rows)
        _, cores = split_cores()
        if learner is not None and self.states is not None:
            body = LearnerBody(learner, self.states.name, board)
            self.learner = Worker("learner process", body, cores)
        if recording is not None and self.samples is not None:
            record = RecorderBody(recording, self.samples.name, board, *self._names)
            self.recorder = Worker("recorder process", record, cores, RECORDER_NICE)
        shown = self.states or self.samples
        if watch is not None and shown is not None:
            show = WatchBody(watch, shown.name, board)
            self.watcher = Worker("display process", show, cores, WATCH_NICE)
        for worker in (self.recorder, self.learner, self.watcher):
            if worker is not None:
                worker.wait_ready(cancelled=cancelled)

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
        if self.learner is not None and self.states is not None and self.states.push(record):
            self.passed_on += 1
        elif self._jobs[0] is not None:
            self.unlearned += 1

    def keep(self, sample: JointSample, command: Array | None) -> None:
        """Hand a sample to the recorder; never waits."""
        if self.samples is not None and self.recorder is not None:
            self.raw.fill(self._record, sample, command)
            self.unrecorded += not self.samples.push(self._record)

    def look_after(self) -> None:
        """Notice workers that died; each is told once."""
        if self.learner is not None and not self.learner.alive:
            self._mourn(self.learner, "the arm goes on, nothing more is learned")
            self.learner = None
        if self.recorder is not None and not self.recorder.alive:
            self._mourn(self.recorder, "the arm goes on, nothing more is recorded")
            self.recorder = None

    def _mourn(self, worker: Worker, consequence: str) -> None:
        worker.finish(lambda: 0, stall_s=0.0)
        self._let_go(worker)
        line = f"{worker.trouble or f'the {worker.name} ended early'}; {consequence}"
        self.troubles.append(line)
        self._say(line)

    def _let_go(self, worker: Worker) -> None:
        """Empty the ring of a dead worker, which a display may be waiting for."""
        ring = self.states if worker.name.startswith("learner") else self.samples
        if ring is not None:
            ring.release(ring.unread)

    def finish(self, hurry: Callable[[], bool]) -> tuple[Any, int | None]:
        """Let the workers drain their rings and end; results of learner and recorder.

        Args:
            hurry: true when somebody no longer wants to wait for the learner.
        """
        self.look_after()
        for ring in (self.states, self.samples):
            if ring is not None:
                ring.finish()
        collected, recorded = None, None
        if self.learner is not None and self.states is not None:
            states = self.states
            self.learner.finish(lambda: states.released, hurry=hurry)
            collected = self._close_book(self.learner)
        if self.recorder is not None and self.samples is not None:
            samples = self.samples
            self.recorder.finish(lambda: samples.released)
            recorded = self._close_book(self.recorder)
        if self.watcher is not None:
            self.watcher.finish(lambda: 0, stall_s=WATCH_STALL_S)
        return collected, recorded

    def _close_book(self, worker: Worker) -> Any:
        if worker.trouble is not None:
            self.troubles.append(worker.trouble)
            self._say(worker.trouble)
            self._let_go(worker)
        return worker.result

    def close(self) -> None:
        """End what still runs and free all memory; may be called more than once."""
        for worker in (self.learner, self.recorder, self.watcher):
            if worker is not None:
                worker.kill()
        for part in (self.states, self.samples, self.board):
            if part is not None:
                part.close()
                part.unlink()
        self.states = self.samples = self.board = None
