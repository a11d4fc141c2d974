"""What the worker processes run: learn, record, show, each until its ring is drained."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from adapter.realtime.jobs import LearnerJob, RecordingJob, View, WatchJob
from adapter.realtime.raw import RawLayout
from adapter.realtime.ring import Ring
from adapter.realtime.shared import remove
from adapter.realtime.snapshot import SnapshotReader, SnapshotWriter
from adapter.realtime.worker import Port
from drivers.mcap_file import FLUSH_S, McapWriter

IDLE_S = 1e-3  # a worker without work looks again after so long
ROWS_AT_ONCE = 16  # between two looks at the clock


@dataclass(frozen=True)
class LearnerBody:
    """Run by the learner process."""

    job: LearnerJob
    ring: str
    snapshot: str | None

    def __call__(self, port: Port) -> Any:
        """Learn until the ring is finished and drained; returns what `collect` gives."""
        ring = Ring.attach(self.ring)
        board = None if self.snapshot is None else SnapshotWriter.attach(self.snapshot)
        try:
            learner = self.job.make()
            if "torch" in sys.modules:
                sys.modules["torch"].set_num_threads(1)
            port.ready()
            self._feed(learner, ring, board, port)
            return self.job.collect(learner)
        finally:
            names = [self.ring] if self.snapshot is None else [self.ring, self.snapshot]
            _leave(port, names, ring, board)

    def _feed(self, learner: Any, ring: Ring, board: SnapshotWriter | None, port: Port) -> None:
        job = self.job
        own = np.zeros(ring.size)  # the learner never sees memory that the loop writes to
        fresh, publish_at, save_at = False, 0.0, time.monotonic() + job.save_s
        while True:
            finished = ring.finished
            rows = ring.peek(ROWS_AT_ONCE)
            for row in rows:
                own[:] = row
                learner.step(own)
            count = len(rows)
            del rows
            ring.release(count)
            fresh = fresh or count > 0
            now = time.monotonic()
            drained = not count and (finished or port.orphaned)
            due = fresh and (now >= publish_at or drained)
            if due and board is not None and job.publish is not None:
                board.publish(job.publish(learner))
                fresh, publish_at = False, now + job.publish_s
            if job.save is not None and (now >= save_at or drained):
                job.save(learner)
                save_at = now + job.save_s
            if drained:
                return
            if not count:
                time.sleep(IDLE_S)


@dataclass(frozen=True)
class RecorderBody:
    """Run by the recorder process."""

    job: RecordingJob
    ring: str
    snapshot: str | None
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]

    def __call__(self, port: Port) -> int:
        """Record until the ring is finished and drained; returns the samples written.

        A recording without a single sample is removed. Raises DriverError.
        """
        ring = Ring.attach(self.ring)
        reader = None if self.snapshot is None else SnapshotReader(self.snapshot)
        job = self.job
        try:
            writer = McapWriter(
                job.path, self.joint_names, self.link_names, job.metadata, overwrite=job.overwrite
            )
            with writer:
                for name, data in job.attachments.items():
                    writer.attach(name, data, "application/octet-stream")
                port.ready()
                written = self._drain(writer, ring, reader, port)
            if not written:
                job.path.unlink(missing_ok=True)
            return written
        finally:
            _leave(port, [self.ring], ring, reader)

    def _drain(
        self, writer: McapWriter, ring: Ring, reader: SnapshotReader | None, port: Port
    ) -> int:
        layout = RawLayout(len(self.joint_names), len(self.link_names))
        own, written, version = layout.new(), 0, 0
        flush_at = estimate_at = time.monotonic()
        while True:
            finished = ring.finished
            rows = ring.peek(ROWS_AT_ONCE)
            for row in rows:
                own[:] = row
                sample, command = layout.sample(own)
                writer.write(sample)
                if command is not None:
                    writer.write_command(sample.stamp_ns, command)
            count = len(rows)
            del rows
            ring.release(count)
            written += count
            now = time.monotonic()
            drained = not count and (finished or port.orphaned)
            if reader is not None and (now >= estimate_at or drained):
                version = self._estimate(writer, reader, version)
                estimate_at = now + self.job.estimate_s
            if not count and now >= flush_at:  # while it writes, the writer flushes by itself
                writer.flush()
                flush_at = now + FLUSH_S
            if drained:
                return written
            if not count:
                time.sleep(IDLE_S)

    def _estimate(self, writer: McapWriter, reader: SnapshotReader, version: int) -> int:
        snapshot = reader.read()
        if snapshot.version == version:
            return version
        describe = asdict if self.job.describe is None else self.job.describe
        writer.write_estimate(snapshot.stamp_ns, dict(describe(snapshot)))
        return snapshot.version


@dataclass(frozen=True)
class WatchBody:
    """Run by the display's process."""

    job: WatchJob
    ring: str
    snapshot: str | None

    def __call__(self, port: Port) -> None:
        """Show until the ring is finished and drained."""
        ring = Ring.attach(self.ring, touch=False)
        reader = None if self.snapshot is None else SnapshotReader(self.snapshot)
        try:
            show = self.job.make()
            port.ready()
            begin = time.monotonic()
            done = False
            while not done:
                done = (ring.finished and not ring.unread) or port.orphaned
                snapshot = None if reader is None else reader.read()
                elapsed_s = time.monotonic() - begin
                show(View(ring.pushed, ring.unread, elapsed_s, snapshot, done))
                if not done:
                    time.sleep(self.job.period_s)
        finally:
            _leave(port, [], ring, reader)


def _leave(
    port: Port, names: list[str], ring: Ring, board: SnapshotWriter | SnapshotReader | None
) -> None:
    """Let go of the memory; remove it where nobody else is left to do so."""
    ring.close()
    if board is not None:
        board.close()
    if port.orphaned:
        for name in names:
            remove(name)
