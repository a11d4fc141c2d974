"""What the recorder and the display run, each until its ring is drained."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

from adapter.realtime.jobs import RecordingJob, View, WatchJob
from adapter.realtime.raw import RawLayout
from adapter.realtime.ring import Ring
from adapter.realtime.shared import leave
from adapter.realtime.snapshot import SnapshotReader
from adapter.realtime.worker import IDLE_S, ROWS_AT_ONCE, Port
from drivers.mcap_file import FLUSH_S, McapWriter

HAND_OVER_S = 0.8 * FLUSH_S  # samples are given back to the loop when the system has them


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

        What is written is given back once the system has it, so that the successor of a recorder
        that died goes on without a hole. A recording without a single sample is removed. Raises
        DriverError.
        """
        ring = Ring.attach(self.ring)
        reader = None if self.snapshot is None else SnapshotReader(self.snapshot)
        job = self.job
        ring.resume(ring.released)
        try:
            writer = McapWriter(
                job.path, self.joint_names, self.link_names, job.metadata, overwrite=job.overwrite
            )
            with writer:
                for name, data in job.attachments.items():
                    writer.attach(name, data, "application/octet-stream")
                port.ready()
                written = self._drain(writer, ring, reader, port)
            ring.give_back()
            if not written:
                job.path.unlink(missing_ok=True)
            return written
        finally:
            leave(port.orphaned, [self.ring], ring, reader)

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
            ring.take(count)
            written += count
            now = time.monotonic()
            drained = not count and (finished or port.orphaned)
            if reader is not None and (now >= estimate_at or drained):
                version = self._estimate(writer, reader, version)
                estimate_at = now + self.job.estimate_s
            if now >= flush_at or 2 * ring.kept > ring.rows:
                writer.flush()
                ring.give_back()
                flush_at = now + HAND_OVER_S
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
            leave(False, [], ring, reader)
