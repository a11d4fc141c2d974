"""From filtered states at the arm's rate to a few rows a second, and their noise level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.records import Array, StateLayout, stamp_of

BLOCK_NS = 40_000_000  # states averaged to one row: 25 rows a second
HOLE_NS = 20_000_000  # a longer hole between two states ends a block without a row
ROWS_PER_GROUP = 5
CLIP = 9.0  # times its level: what a row says at most about the level
LEVEL_ROWS, LEVEL_SUMS = 250.0, 40.0  # rows and sums that the level is averaged over
START_SUMS = 5.0  # that the first guess of the level counts
LEAST_INFLATION = 1.2


class Blocks:
    """Averages states; cheap for each of them.

    Args:
        n: joints.
    """

    def __init__(self, n: int) -> None:
        at = StateLayout(n)
        self._n, self._signals = n, slice(at.q.start, at.tau.stop)
        self._sum = np.zeros(4 * n)
        self._count, self._begin_ns, self._last_ns, self._stamps = 0, 0, 0, 0

    def add(self, table: Array) -> list[tuple[float, Array]]:
        """Take states (m, size); rows (s, (4 n,)) of the blocks that they complete."""
        if len(table) == 1:
            done = self._add_one(table[0])
            return [] if done is None else [done]
        return [row for state in table if (row := self._add_one(state)) is not None]

    def _add_one(self, state: Array) -> tuple[float, Array] | None:
        stamp = stamp_of(state)
        done = None
        if self._count and not 0 < stamp - self._last_ns <= HOLE_NS:
            self._count = 0
        elif self._count and stamp - self._begin_ns >= BLOCK_NS:
            middle = self._begin_ns + self._stamps / self._count
            done = 1e-9 * middle, self._sum / self._count
            self._count = 0
        if not self._count:
            self._sum[:] = 0.0
            self._begin_ns, self._stamps = stamp, 0
        self._sum += state[self._signals]
        self._stamps += stamp - self._begin_ns
        self._count += 1
        self._last_ns = stamp
        return done


@dataclass(eq=False)
class Group:
    """`ROWS_PER_GROUP` rows with all that is computed of them once.

    Attributes:
        t: (r,) s; Z: (r, n, D0) regressor and the learned effects' columns; S: (r, n, K)
            signatures; tau: (r, n).
    """

    t: Array
    Z: Array
    S: Array
    tau: Array


class Level:
    """Running noise level of each joint: of rows, and of sums over 0.4 s, which are what counts.

    Noise of arms is coloured: a sum of rows varies more than that many independent rows would.

    Args:
        variance: (n,) first guess of a row's, (N m)²; inflation: first guess of how many times
            more a sum of rows varies.
    """

    def __init__(self, variance: Array, inflation: float) -> None:
        self.row = variance.copy()
        self.long = inflation * variance
        self._rows, self._sums = START_SUMS * 2 * ROWS_PER_GROUP, START_SUMS
        self._half: Array | None = None

    def look(self, residual: Array) -> None:
        """Take the residual (r, n) of one group."""
        for r in residual**2:
            self._rows = min(self._rows + 1.0, LEVEL_ROWS)
            self.row += (np.minimum(r, CLIP * self.row) - self.row) / self._rows
        if self._half is None:
            self._half = residual.sum(axis=0)
            return
        count = 2 * len(residual)
        power = (self._half + residual.sum(axis=0)) ** 2 / count
        self._half = None
        self._sums = min(self._sums + 1.0, LEVEL_SUMS)
        self.long += (np.minimum(power, CLIP * self.long) - self.long) / self._sums

    @property
    def weight(self) -> Array:
        """(n,) information that one row has, 1/(N m)²."""
        return np.asarray(1.0 / np.maximum(self.long, LEAST_INFLATION * self.row))
