"""What the loop says of itself, in shared memory: timing as it is counted, lines, how it ended.

The loop writes without a wait and without a lock; who looks at it costs it nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapter.realtime.ring import read_before, set_after
from adapter.realtime.shared import SharedBlock
from adapter.realtime.timing import BINS, COUNTED, Histogram

MISSED, MISSED_OWN, LINES_LENGTH, END_LENGTH, BEGAN = range(5)  # words of the header
HEADER_WORDS, LINES_BYTES, END_BYTES, LINE_BYTES = 16, 16384, 2048, 1000
START = 8 * HEADER_WORDS
BLOCK_BYTES = START + LINES_BYTES + END_BYTES + 8 * len(COUNTED) * BINS


@dataclass(frozen=True)
class LoopTiming:
    """The loop's timing as it stands.

    Attributes:
        bins: (len(COUNTED), BINS) counts, a copy.
        missed, missed_own: deadlines, as in a `TimingReport`.
    """

    bins: NDArray[np.int64]
    missed: int
    missed_own: int

    def of(self, what: str) -> Histogram:
        """One of `COUNTED`."""
        return Histogram.of(self.bins[COUNTED.index(what)])

    def since(self, before: LoopTiming) -> LoopTiming:
        """What was counted after an earlier look."""
        return LoopTiming(
            self.bins - before.bins,
            self.missed - before.missed,
            self.missed_own - before.missed_own,
        )


class LoopBoard:
    """See the module.

    Attributes:
        name: of the shared block, for `attach`.
        bins: (len(COUNTED), BINS) for `Timing` to count in.
    """

    def __init__(self, block: SharedBlock) -> None:
        self.name, self._block = block.name, block
        self._header: NDArray[np.int64] = block.array((HEADER_WORDS,), np.int64, 0)
        self._lines: NDArray[np.uint8] = block.array((LINES_BYTES,), np.uint8, START)
        self._end: NDArray[np.uint8] = block.array((END_BYTES,), np.uint8, START + LINES_BYTES)
        at = START + LINES_BYTES + END_BYTES
        self.bins: NDArray[np.int64] = block.array((len(COUNTED), BINS), np.int64, at)

    @classmethod
    def create(cls) -> LoopBoard:
        """One with nothing on it. Raises SharedMemoryError."""
        board = cls(SharedBlock.create(BLOCK_BYTES))
        board.count_missed(0, 0)  # compiled (or loaded) before the clock runs
        return board

    @classmethod
    def attach(cls, name: str) -> LoopBoard:
        """The same in a worker process. Raises FileNotFoundError."""
        return cls(SharedBlock.attach(name, own=True))

    def count_missed(self, missed: int, own: int) -> None:
        """Loop: deadlines missed so far, and those of them by our own work."""
        set_after(self._header, MISSED, missed)
        set_after(self._header, MISSED_OWN, own)

    def write_begin(self, stamp_ns: int) -> None:
        """Loop: stamp of the first that was passed on, on the arm's clock."""
        set_after(self._header, BEGAN, stamp_ns)

    @property
    def began_ns(self) -> int:
        """Anybody: that stamp; 0 before."""
        return int(self._header[BEGAN])

    def write_line(self, line: str) -> bool:
        """Loop: a line for people; false where there is no room left for it."""
        data = line.replace("\n", " ").encode()[:LINE_BYTES] + b"\n"
        return self._append(self._lines, LINES_LENGTH, data)

    def write_end(self, ended: str, fault: str | None) -> None:
        """Loop: why the run came to its end (`Ended`), and what was wrong."""
        data = f"{ended}\n{fault or ''}".encode()[: END_BYTES - 1]
        self._append(self._end, END_LENGTH, data)

    def _append(self, area: NDArray[np.uint8], word: int, data: bytes) -> bool:
        start = int(self._header[word])
        stop = start + len(data)
        if stop > len(area):
            return False
        area[start:stop] = np.frombuffer(data, np.uint8)
        set_after(self._header, word, stop)
        return True

    def timing(self) -> LoopTiming:
        """Anybody: what was counted so far; takes some 0.2 ms."""
        missed = int(self._header[MISSED]), int(self._header[MISSED_OWN])
        return LoopTiming(self.bins.copy(), *missed)

    def lines(self) -> list[str]:
        """Anybody: all lines so far."""
        return self._text(self._lines, LINES_LENGTH).splitlines()

    def end(self) -> tuple[str, str] | None:
        """Anybody: why the run came to its end and what was wrong ("" for nothing); None before."""
        text = self._text(self._end, END_LENGTH)
        if not text:
            return None
        ended, _, fault = text.partition("\n")
        return ended, fault

    def _text(self, area: NDArray[np.uint8], word: int) -> str:
        length = int(read_before(self._header, word))
        return area[:length].tobytes().decode(errors="replace")

    def close(self) -> None:
        """Let go of it in this process; may be called more than once."""
        self._header, self.bins = self._header.copy(), self.bins.copy()
        self._lines, self._end = self._lines.copy(), self._end.copy()
        self._block.close()

    def unlink(self) -> None:
        """Creator: remove its name."""
        self._block.unlink()
