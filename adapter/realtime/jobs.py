"""What the workers are asked to do, and what their processes run until their ring is drained.

A `...Job` says what to learn or record (or show: `showing`); all of it is picklable. A `...Task`
runs in the worker's process.

A learner that dies is succeeded by one that takes its last kept state and, from the ring, all
that came after it. The name of a kept state is the number of records behind it, and a record is
given back only when a state that has learned it is kept: nothing is learned twice, and what the
ring no longer holds is counted as skipped.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.model.spatial import Array
from adapter.realtime.ring import RawLayout, Ring
from adapter.realtime.run_messages import RunMessages, ShownArm, estimate_names
from adapter.realtime.shared import leave
from adapter.realtime.showing import DisplayJob
from adapter.realtime.snapshot import ExternalTorque, Snapshot, SnapshotReader, SnapshotWriter
from adapter.realtime.timing import LoopBoard
from adapter.realtime.worker import IDLE_S, ROWS_AT_ONCE, Port
from drivers.files.mcap import FLUSH_S, McapWriter
from drivers.files.messages import Message

# How often news are published, and how often a recorder tells an estimate, the links' places and
# what the loop's timing was meanwhile.
NEWS_S, ESTIMATE_S, FRAMES_S, TIMING_S = 0.25, 0.1, 1.0 / 30.0, 1.0


@dataclass(frozen=True)
class LearnerJob:
    """The learner process. The callables are top-level functions or partials of such.

    Attributes:
        make: builds the learner there: whatever has a `step` for a record of `StateLayout`, which
            it must copy to keep.
        collect: what comes back at the end, picklable.
        publish: the estimate as it stands; None publishes nothing.
        news: what was found so far, for `SnapshotWriter.publish_news`; None says nothing.
        save: writes a checkpoint; None writes none.
        keep: writes the whole state into an empty folder (learner, folder), for a successor if
            this process dies; restore: puts a fresh learner into it. Where None, nobody succeeds.
        effect_names: effects in the published estimate.
        publish_s, save_s: how often.
    """

    make: Callable[[], Any]
    collect: Callable[[Any], Any]
    publish: Callable[[Any], Snapshot] | None = None
    news: Callable[[Any], Mapping[str, Any]] | None = None
    save: Callable[[Any], None] | None = None
    keep: Callable[[Any, Path], None] | None = None
    restore: Callable[[Any, Path], None] | None = None
    effect_names: tuple[str, ...] = ()
    publish_s: float = 0.01
    save_s: float = 5.0


@dataclass(frozen=True)
class RecordingJob:
    """The recorder process.

    Attributes:
        path: of the MCAP file.
        metadata: configuration, version, ...: written at the start.
        attachments: files to put inside, by name.
        arm: told beside the samples, as documented and as learned; None tells no frames.
    """

    path: Path
    metadata: Mapping[str, Any] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    arm: ShownArm | None = None

    def part(self, k: int) -> RecordingJob:
        """The same for the k-th successor of a recorder that died: a file of its own."""
        if k == 0:
            return self
        path = self.path.with_name(f"{self.path.stem}.part{k + 1}{self.path.suffix}")
        return replace(self, path=path)


@dataclass(frozen=True)
class Jobs:
    """What the workers of a run do; None leaves a worker out.

    Attributes:
        display: on the terminal; not followed by another where it dies.
        view: for other programs (browsers); followed by another where it dies.
    """

    learner: LearnerJob | None = None
    recording: RecordingJob | None = None
    display: DisplayJob | None = None
    view: DisplayJob | None = None


def drain(
    ring: Ring, port: Port, take: Callable[[Array], object]
) -> Iterator[tuple[int, float, bool]]:
    """Hand records to `take` until the ring is finished and drained, or nobody is left.

    What is taken is a copy: nobody sees memory that the loop writes to. Yields again and again how
    many were taken, the time, and whether nothing comes any more.
    """
    own, drained = np.zeros(ring.size), False
    while not drained:
        finished = ring.finished
        rows = ring.peek(ROWS_AT_ONCE)
        for row in rows:
            own[:] = row
            take(own)
        count = len(rows)
        del rows
        ring.take(count)
        drained = not count and (finished or port.orphaned)
        yield count, time.monotonic(), drained
        if not count and not drained:
            time.sleep(IDLE_S)


@dataclass(frozen=True)
class LearnerTask:
    """Run by the learner process.

    Attributes:
        job: what to do.
        ring: name of the ring; snapshot: of the estimate's board.
        keep_in: private folder for kept states; None keeps none.
    """

    job: LearnerJob
    ring: str
    snapshot: str | None
    keep_in: Path | None = None

    def __call__(self, port: Port) -> Any:
        """Learn until the ring is finished and drained; returns what `collect` gives."""
        ring = Ring.attach(self.ring)
        board = None if self.snapshot is None else SnapshotWriter.attach(self.snapshot)
        try:
            learner = self.job.make()
            if "torch" in sys.modules:
                sys.modules["torch"].set_num_threads(1)
            # go on where a dead predecessor's last kept state ends
            index = 0
            if self.keep_in is not None and self.job.restore is not None:
                index = max(
                    (int(p.name) for p in self.keep_in.iterdir() if p.name.isdigit()), default=0
                )
                if index:
                    self.job.restore(learner, self.keep_in / str(index))
            ring.resume(index)
            port.ready()
            self._feed(learner, ring, board, port)
            return self.job.collect(learner)
        finally:
            names = [self.ring] if self.snapshot is None else [self.ring, self.snapshot]
            leave(port.orphaned, names, ring, board)
            if port.orphaned and self.keep_in is not None:
                shutil.rmtree(self.keep_in, ignore_errors=True)

    def _feed(self, learner: Any, ring: Ring, board: SnapshotWriter | None, port: Port) -> None:
        job = self.job
        keeping = self.keep_in is not None and job.keep is not None
        fresh, publish_at, news_at = False, 0.0, 0.0
        save_at = keep_at = time.monotonic() + job.save_s
        for count, now, drained in drain(ring, port, learner.step):
            if not keeping:
                ring.give_back()
            fresh = fresh or count > 0
            due = fresh and (now >= publish_at or drained)
            if due and board is not None and job.publish is not None:
                board.publish(job.publish(learner))
                fresh, publish_at = False, now + job.publish_s
            if board is not None and job.news is not None and (now >= news_at or drained):
                board.publish_news(job.news(learner))
                news_at = now + NEWS_S
            if keeping and (now >= keep_at or 2 * ring.kept > ring.rows):
                self._keep(learner, ring)
                keep_at = now + job.save_s
            if job.save is not None and (now >= save_at or drained):
                job.save(learner)
                save_at = now + job.save_s

    def _keep(self, learner: Any, ring: Ring) -> None:
        """Keep a state, then give back what it has learned and remove those before it."""
        folder, job, index = self.keep_in, self.job, ring.taken
        assert folder is not None and job.keep is not None
        place = folder / "next"
        try:
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            job.keep(learner, place)
            if not (folder / str(index)).exists():
                place.rename(folder / str(index))
        except OSError:  # no room: the loop's need of the ring goes before a successor's
            if 2 * ring.kept > ring.rows:
                ring.give_back()
            return
        ring.give_back()
        for old in folder.iterdir():
            if old.name != str(index):
                shutil.rmtree(old, ignore_errors=True)


@dataclass(frozen=True)
class RecorderTask:
    """Run by the recorder process."""

    job: RecordingJob
    ring: str
    snapshot: str | None
    loop: str | None
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]

    def __call__(self, port: Port) -> int:
        """Record until the ring is finished and drained; returns the samples written.

        What is written is given back once the system has it, so that the successor of a recorder
        that died goes on without a hole. A recording without a single sample is removed. Raises
        DriverError.
        """
        ring = Ring.attach(self.ring)
        reader = None if self.snapshot is None else SnapshotReader(self.snapshot)
        board = None if self.loop is None else LoopBoard.attach(self.loop)
        job = self.job
        ring.resume(ring.released)
        try:
            writer = McapWriter(job.path, self.joint_names, self.link_names, job.metadata)
            with writer:
                for name, data in job.attachments.items():
                    writer.attach(name, data, "application/octet-stream")
                beside = Beside(writer, job, (reader, board), self.joint_names)
                port.ready()
                written = self._drain(writer, ring, beside, port)
            ring.give_back()
            if not written:
                job.path.unlink(missing_ok=True)
            return written
        finally:
            leave(port.orphaned, [self.ring], ring, reader, board)

    def _drain(self, writer: McapWriter, ring: Ring, beside: Beside, port: Port) -> int:
        layout = RawLayout(len(self.joint_names), len(self.link_names))
        flush_at, written = time.monotonic(), 0

        def write(record: Array) -> None:
            sample, command, external = layout.sample(record)
            writer.write(sample)
            if command is not None:
                writer.write_command(sample.stamp_ns, command)
            if external is not None:
                writer.write_external(sample.stamp_ns, external)
            beside.sample(sample.stamp_ns, sample.q)

        for count, now, drained in drain(ring, port, write):
            written += count
            beside.look(now, drained)
            if now >= flush_at or 2 * ring.kept > ring.rows:
                writer.flush()
                ring.give_back()
                flush_at = now + 0.8 * FLUSH_S  # the system has them by then
        return written


class Beside:
    """What a recorder writes beside the samples, each at its time.

    Args:
        writer: of the file.
        job: what to tell.
        sources: of the estimate and of the loop's timing; None where there is none.
        joint_names: of the arm.
    """

    def __init__(
        self,
        writer: McapWriter,
        job: RecordingJob,
        sources: tuple[SnapshotReader | None, LoopBoard | None],
        joint_names: tuple[str, ...],
    ) -> None:
        self._writer = writer
        self._reader, self._board = sources
        names = estimate_names(joint_names, self._reader, job.arm)
        self._messages = RunMessages(names, job.arm)
        self._stamp_ns = self._frames_at_ns = 0
        self._look_at = self._timing_at = 0.0
        self._pushes: deque[ExternalTorque] = deque(maxlen=100)

    def sample(self, stamp_ns: int, q: Array) -> None:
        """A sample was written."""
        if not self._stamp_ns:
            self._write(self._messages.first(stamp_ns))
        self._stamp_ns = stamp_ns
        while self._pushes and self._pushes[0].stamp_ns <= stamp_ns:
            self._write(self._messages.push(self._pushes.popleft(), q))
        if abs(stamp_ns - self._frames_at_ns) < 1e9 * FRAMES_S:
            return
        self._frames_at_ns = stamp_ns
        self._write(self._messages.frames(stamp_ns, q))
        if self._reader is not None:
            self._pushes.append(self._reader.read_external())

    def look(self, now: float, last: bool) -> None:
        """Tell what others know, where it is new; `last` when nothing comes any more."""
        if not self._stamp_ns or not (now >= self._look_at or last):
            return
        self._look_at = now + ESTIMATE_S
        if self._reader is not None:
            self._write(self._messages.estimate(self._reader.read()))
            self._write(self._messages.news(self._stamp_ns, self._reader.read_news()))
        if self._board is not None and (now >= self._timing_at or last):
            self._timing_at = now + TIMING_S
            self._write(self._messages.timing(self._stamp_ns, self._board.timing()))

    def _write(self, messages: Iterable[Message]) -> None:
        for message in messages:
            self._writer.write_message(message)
