"""What the learner process runs: learn until the ring is drained, and leave its state behind.

A learner that dies is succeeded by one that takes its last kept state and, from the ring, all
that came after it. The name of a kept state is the number of records behind it, and a record is
given back only when a state that has learned it is kept: nothing is learned twice, and what the
ring no longer holds is counted as skipped.
"""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapter.realtime.jobs import LearnerJob
from adapter.realtime.ring import Ring
from adapter.realtime.shared import leave
from adapter.realtime.snapshot import SnapshotWriter
from adapter.realtime.worker import IDLE_S, ROWS_AT_ONCE, Port

UNFINISHED = "next"


@dataclass(frozen=True)
class LearnerBody:
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
            self._take_over(learner, ring)
            port.ready()
            self._feed(learner, ring, board, port)
            return self.job.collect(learner)
        finally:
            names = [self.ring] if self.snapshot is None else [self.ring, self.snapshot]
            leave(port.orphaned, names, ring, board)
            if port.orphaned and self.keep_in is not None:
                shutil.rmtree(self.keep_in, ignore_errors=True)

    def _take_over(self, learner: Any, ring: Ring) -> None:
        """Go on where a dead predecessor's last kept state ends."""
        index = 0
        if self.keep_in is not None and self.job.restore is not None:
            index = max(
                (int(p.name) for p in self.keep_in.iterdir() if p.name.isdigit()), default=0
            )
            if index:
                self.job.restore(learner, self.keep_in / str(index))
        ring.resume(index)

    def _feed(self, learner: Any, ring: Ring, board: SnapshotWriter | None, port: Port) -> None:
        job = self.job
        keeping = self.keep_in is not None and job.keep is not None
        own = np.zeros(ring.size)  # the learner never sees memory that the loop writes to
        fresh, publish_at = False, 0.0
        save_at = keep_at = time.monotonic() + job.save_s
        while True:
            finished = ring.finished
            rows = ring.peek(ROWS_AT_ONCE)
            for row in rows:
                own[:] = row
                learner.step(own)
            count = len(rows)
            del rows
            ring.take(count)
            if not keeping:
                ring.give_back()
            fresh = fresh or count > 0
            now = time.monotonic()
            drained = not count and (finished or port.orphaned)
            due = fresh and (now >= publish_at or drained)
            if due and board is not None and job.publish is not None:
                board.publish(job.publish(learner))
                fresh, publish_at = False, now + job.publish_s
            if keeping and (now >= keep_at or 2 * ring.kept > ring.rows):
                self._keep(learner, ring)
                keep_at = now + job.save_s
            if job.save is not None and (now >= save_at or drained):
                job.save(learner)
                save_at = now + job.save_s
            if drained:
                return
            if not count:
                time.sleep(IDLE_S)

    def _keep(self, learner: Any, ring: Ring) -> None:
        """Keep a state, then give back what it has learned and remove those before it."""
        folder, job, index = self.keep_in, self.job, ring.taken
        assert folder is not None and job.keep is not None
        place = folder / UNFINISHED
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
