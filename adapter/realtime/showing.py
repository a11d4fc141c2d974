"""Showing a run: a process that looks at the shared memory, and never holds anybody up."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from adapter.model.spatial import Array
from adapter.realtime.ring import Ring
from adapter.realtime.shared import leave
from adapter.realtime.snapshot import ExternalTorque, Snapshot, SnapshotError, SnapshotReader
from adapter.realtime.timing import LoopBoard, LoopTiming
from adapter.realtime.worker import Port

NEWEST = 512  # records that one look takes in at most
TIMING_S = 0.5  # between two looks at the timing, of which there is a megabyte

T = TypeVar("T")


@dataclass(frozen=True)
class View:
    """What a display shows.

    Attributes:
        samples: passed on by the loop so far (filtered states where it learns).
        waiting: of these, not taken by their worker yet.
        elapsed_s: since the display began.
        snapshot: the newest estimate, None where none is published.
        done: nothing comes any more.
        records: (m, size) what was passed on since the last look, the newest `NEWEST` of it.
        push: what pushes the arm; None where nobody says.
        news: what the learner found, see `SnapshotReader.read_news`.
        timing: of the loop, at most `TIMING_S` old; None where it does not say.
        lines: all that was said to people in the loop so far.
        began_ns: stamp of the first of `samples`, on the arm's clock; 0 where it is not known.
        ended: why the loop came to its end and what was wrong; None before.
    """

    samples: int
    waiting: int
    elapsed_s: float
    snapshot: Snapshot | None
    done: bool
    records: Array = field(default_factory=lambda: np.zeros((0, 0)))
    push: ExternalTorque | None = None
    news: dict[str, Any] = field(default_factory=dict)
    timing: LoopTiming | None = None
    lines: list[str] = field(default_factory=list)
    began_ns: int = 0
    ended: tuple[str, str] | None = None


@dataclass(frozen=True)
class DisplayJob:
    """A display in its own process, so that a slow terminal or browser never holds up the loop.

    Attributes:
        make: builds the display there; it is called with a `View` again and again, at last with
            one that is `done`.
        period_s: how often.
        says: it says the loop's lines itself, so that they do not run into what it shows.
        idle: it runs only where nobody else wants the processor.
    """

    make: Callable[[], Callable[[View], None]]
    period_s: float = 0.25
    says: bool = False
    idle: bool = False


@dataclass(frozen=True)
class DisplayTask:
    """Run by the display's process.

    Attributes:
        job: what to do.
        ring, snapshot, loop: names in shared memory; of what is not there None.
    """

    job: DisplayJob
    ring: str
    snapshot: str | None = None
    loop: str | None = None

    def __call__(self, port: Port) -> None:
        """Show until the ring is finished and drained."""
        ring = Ring.attach(self.ring, touch=False)
        reader = None if self.snapshot is None else SnapshotReader(self.snapshot)
        board = None if self.loop is None else LoopBoard.attach(self.loop)
        try:
            show = self.job.make()
            port.ready()
            if self.job.idle:  # threads that begin later inherit it
                with suppress(OSError, AttributeError):  # as far as the system lets
                    os.nice(19)
                    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
            looker = Looker(ring, reader, board)
            done = False
            while not done:
                done = (ring.finished and not ring.unread) or port.orphaned
                show(looker.look(done))
                if not done:
                    time.sleep(self.job.period_s)
        finally:
            leave(False, [], ring, reader, board)


class Looker:
    """Reads all there is to see of a run, again and again.

    Args:
        ring: of what the loop passes on.
        reader: of the estimate; board: of the loop; None where there is none.
    """

    def __init__(self, ring: Ring, reader: SnapshotReader | None, board: LoopBoard | None) -> None:
        self._ring, self._reader, self._board = ring, reader, board
        self._begin, self._seen, self._timed = time.monotonic(), 0, -np.inf
        self._timing: LoopTiming | None = None
        self._snapshot: Snapshot | None = None
        self._push: ExternalTorque | None = None
        self._news: dict[str, Any] = {}

    def look(self, done: bool) -> View:
        """What is to be seen now."""
        ring, board, reader = self._ring, self._board, self._reader
        now, pushed = time.monotonic(), ring.pushed
        records = ring.newest(min(pushed - self._seen, NEWEST))
        self._seen = pushed
        if board is not None and (done or now - self._timed >= TIMING_S):
            self._timing, self._timed = board.timing(), now
        if reader is not None:
            self._snapshot = newer(self._snapshot, reader.read)
            self._push = newer(self._push, reader.read_external)
            self._news = newer(self._news, reader.read_news)
        return View(
            pushed,
            ring.unread,
            now - self._begin,
            self._snapshot,
            done,
            records,
            None if self._push is None or not self._push.version else self._push,
            self._news,
            self._timing,
            [] if board is None else board.lines(),
            0 if board is None else board.began_ns,
            None if board is None else board.end(),
        )


def newer(before: T, read: Callable[[], T]) -> T:
    """What is read; what was there before where the writer overtook again and again."""
    with suppress(SnapshotError):
        return read()
    return before
