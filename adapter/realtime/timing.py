"""What the loop says of itself: timing as it is counted, lines, how it ended.

It is counted in memory that does not grow and may be shared with other processes (`LoopBoard`),
which read the counts as they stand. The loop writes without a wait and without a lock; who looks
at it costs it nothing.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.realtime.ring import read_before, set_after
from adapter.realtime.shared import SharedBlock

SHARES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9}
BITS = 9  # a bin is narrower than 1/512 of its value
BINS = (40 + 2) << BITS  # 40 octaves: up to 2^47 ns, a day and a half
# What is counted, in the order of the rows of a `Timing`'s bins.
COUNTED = ("tick_us", "loop_us", "plant_us", "lateness_us", "period_us", "age_us")


class Histogram:
    """Durations in bins of equal relative width; the largest and the sum exactly.

    Args:
        bins: (BINS,) of zeros to count in; own ones where None.
    """

    def __init__(self, bins: NDArray[np.int64] | None = None) -> None:
        self._bins = np.zeros(BINS, np.int64) if bins is None else bins
        self.count = 0
        self.total_ns = 0
        self.max_ns = 0

    def add(self, ns: int, times: int = 1) -> None:
        """Count a duration, so many times; a negative one counts as zero."""
        if ns < 0:
            ns = 0
        shift = ns.bit_length() - BITS - 1
        self._bins[ns if shift <= 0 else (shift << BITS) + (ns >> shift)] += times
        self.count += times
        self.total_ns += ns * times
        if ns > self.max_ns:
            self.max_ns = ns

    @classmethod
    def of(cls, bins: NDArray[np.int64]) -> Histogram:
        """From the counts (BINS,) alone: the largest then to the width of its bin, no sum."""
        found = cls(bins)
        found.count = int(bins.sum())
        if found.count:
            found.max_ns = upper_ns(int(np.flatnonzero(bins)[-1]))
        return found

    def percentile_us(self, share: float) -> float | None:
        """The duration that `share` percent do not exceed, µs, to within 0.1 %; None if empty."""
        if not self.count:
            return None
        upto = np.cumsum(self._bins)
        index = int(np.searchsorted(upto, max(share / 100 * self.count, 1.0)))
        width = 1 << max((index >> BITS) - 1, 0)
        return min(upper_ns(index) - 0.5 * (width - 1), self.max_ns) * 1e-3

    def summary_us(self) -> dict[str, float | None]:
        """p50, p99, p99.9 and max, µs; None where nothing was counted."""
        out = {name: self.percentile_us(share) for name, share in SHARES.items()}
        out["max"] = self.max_ns * 1e-3 if self.count else None
        return out


def upper_ns(index: int) -> int:
    """The longest duration that a bin counts."""
    shift = max((index >> BITS) - 1, 0)
    return ((index - (shift << BITS) + 1) << shift) - 1


@dataclass(frozen=True)
class TimingReport:
    """Timing of a live run; the `_us` mappings hold p50, p99, p99.9, max in µs.

    Attributes:
        ticks: how many.
        missed_deadlines: deadlines that went by unused.
        missed_own: of these, such as the loop's own work took too long for; the machine took the
            processor away at the others.
        tick_us: compute of driver, filter and synthesis.
        loop_us: all compute of a tick, controller and hand-over to the workers included.
        plant_us: what a simulated arm took for its physics, in neither of the two above.
        lateness_us: begin of the tick after its deadline; empty where the source sets the pace.
        period_us: between the begins of two ticks, with mean.
        age_us: from a sample's arrival at this machine to the loop having it; empty where the
            driver does not tell.
    """

    ticks: int
    missed_deadlines: int
    missed_own: int
    tick_us: dict[str, float | None]
    loop_us: dict[str, float | None]
    plant_us: dict[str, float | None]
    lateness_us: dict[str, float | None]
    period_us: dict[str, float | None]
    age_us: dict[str, float | None]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """For people."""
        rows = {
            "driver, filter, synthesis": self.tick_us,
            "the whole tick": self.loop_us,
            "physics of the simulated arm": self.plant_us,
            "lateness": self.lateness_us,
            "period": self.period_us,
            "age of a sample when the loop has it": self.age_us,
        }
        return [
            f"{name}, µs: {'  '.join(f'{k} {v:.1f}' for k, v in x.items() if v is not None)}"
            for name, x in rows.items()
            if x["p50"] is not None
        ]


class Timing:
    """Collects while the loop runs; a tick costs some 2 µs.

    Args:
        bins: (len(COUNTED), BINS) of zeros to count in; own ones where None.
    """

    def __init__(self, bins: NDArray[np.int64] | None = None) -> None:
        rows = np.zeros((len(COUNTED), BINS), np.int64) if bins is None else bins
        self._of = dict(zip(COUNTED, map(Histogram, rows), strict=True))
        self._began: int | None = None

    def add(
        self, began: int, stepped: int, ended: int, plant_ns: int, age_ns: int | None = None
    ) -> None:
        """One tick: instants (ns) of its begin, of the filtered state, of its end; physics time;
        age of its sample when the loop had it, None where that has no meaning."""
        if self._began is not None:
            self._of["period_us"].add(began - self._began)
        self._began = began
        self._of["tick_us"].add(stepped - began - plant_ns)
        self._of["loop_us"].add(ended - began - plant_ns)
        if plant_ns:
            self._of["plant_us"].add(plant_ns)
        if age_ns is not None:
            self._of["age_us"].add(age_ns)

    def late(self, ns: int) -> None:
        """A tick began this long after its deadline."""
        self._of["lateness_us"].add(ns)

    def report(self, missed: int = 0, missed_own: int = 0) -> TimingReport:
        """What was collected so far."""
        found, period = {k: x.summary_us() for k, x in self._of.items()}, self._of["period_us"]
        mean_us = 1e-3 * period.total_ns / period.count if period.count else None
        found["period_us"]["mean"] = mean_us
        return TimingReport(self._of["loop_us"].count, missed, missed_own, **found)


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
    """What the loop says of itself, in shared memory.

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
