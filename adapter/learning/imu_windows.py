"""Readings of joints and of sensors on links, on one grid of time, weighed by smooth windows.

A window is a bell w(t), a B-spline of degree 5, that is zero outside some tenths of a second. What
a sensor reads and where the joints say that it was are compared as integrals over windows:

    ∫ w a dt = ∫ w'' p dt,

for an acceleration a of a place p. So positions of joints are never differentiated twice, nothing
is delayed or flattened, however fast the motion, and the noise of both sides is averaged alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adapter.model.spatial import Array
from adapter.signals.frame_topics import LONGEST_PERIODS

STEP_S = 0.005  # of the grid
KNOT_S = 0.06  # between two knots of the bell, and from one window to the next
DEGREE = 5  # so smooth that sums over the grid are integrals to 1e-6
LONGEST_GAP_S = 0.05  # no window spans a longer silence
PER_KNOT = round(KNOT_S / STEP_S)


class Readings(NamedTuple):
    """What was read at the joints' stamps.

    Attributes:
        t_s: (m,) rising, s.
        q: (m, n) rad.
        w, a: (m, s, 3) angular velocity, rad/s, and what the accelerometer reads, m/s², of each
            sensor in its own axes; not a number where it said nothing.
    """

    t_s: Array
    q: Array
    w: Array
    a: Array


class Course:
    """A signal (k, c) as a smooth curve over time.

    Args:
        t_s: (k,) rising, s; at least four.
        x: (k, c).
    """

    def __init__(self, t_s: Array, x: Array) -> None:
        from scipy.interpolate import CubicSpline  # takes long to load, and few runs need it

        period_s = float(np.median(np.diff(t_s)))
        self._longest_s = max(LONGEST_GAP_S, LONGEST_PERIODS * period_s)
        count = int(1.0 / (200.0 * period_s) + 1e-6)  # faster signals are averaged to this
        if count > 1:  # averages of so many readings; none across a gap
            part = np.cumsum(np.diff(t_s, prepend=t_s[0]) > LONGEST_PERIODS * period_s)
            start = np.flatnonzero(np.diff(part, prepend=-1))
            first = np.flatnonzero((np.arange(len(t_s)) - start[part]) % count == 0)
            size = np.diff(first, append=len(t_s))
            t_s, x = np.add.reduceat(t_s, first) / size, np.add.reduceat(x, first) / size[:, None]
        self._t_s = t_s
        self._curve = CubicSpline(t_s, x)

    def at(self, t_s: Array) -> Array:
        """(g, c) at other times."""
        return np.asarray(self._curve(t_s))

    def rate(self, t_s: Array) -> Array:
        """(g, c) its rate of change there."""
        return np.asarray(self._curve(t_s, 1))

    def heard(self, t_s: Array) -> np.ndarray:
        """(g,) whether times lie between readings that are close to each other."""
        behind = np.clip(np.searchsorted(self._t_s, t_s), 1, len(self._t_s) - 1)
        near = self._t_s[behind] - self._t_s[behind - 1] <= self._longest_s
        inside = (t_s >= self._t_s[0]) & (t_s <= self._t_s[-1])
        return np.asarray(near & inside)


@dataclass(frozen=True)
class Windows:
    """Windows over a grid of time with gaps.

    Attributes:
        t_s: (g,) the grid; uniform pieces one after the other.
        starts: (k,) first place on the grid of each window.
    """

    t_s: Array
    starts: np.ndarray

    @classmethod
    def over(cls, course: Course, t_s: Array) -> Windows:
        """On the stretches where a signal with stamps (m,) was heard."""
        grid = np.arange(t_s[0], t_s[-1], STEP_S)
        heard = course.heard(grid)
        part = np.cumsum(np.diff(heard.astype(int), prepend=0) > 0)
        kept, starts, size = [], [], 0
        for k in range(1, part[-1] + 1 if len(part) else 1):
            piece = grid[heard & (part == k)]
            if len(piece) >= len(BELL):
                starts.append(size + np.arange(0, len(piece) - len(BELL) + 1, PER_KNOT))
                kept.append(piece)
                size += len(piece)
        none = [np.zeros(0)]
        return cls(np.concatenate(kept or none), np.concatenate(starts or none).astype(int))

    def whole(self, heard: np.ndarray) -> np.ndarray:
        """(k,) windows in all of which something was heard, from (g,)."""
        missing = np.concatenate([[0], np.cumsum(~heard)])
        return np.asarray(missing[self.starts + len(BELL)] == missing[self.starts])


class Sums:
    """What weighs signals on the grid with a kernel, window by window."""

    def __init__(self, kernel: Array, windows: Windows) -> None:
        from scipy.sparse import csr_array

        count, size = len(windows.starts), len(windows.t_s)
        columns = (windows.starts[:, None] + np.arange(len(kernel))).ravel()
        rows = np.arange(0, len(columns) + 1, len(kernel))
        self._table = csr_array((np.tile(kernel, count), columns, rows), (count, size))

    def __call__(self, x: Array) -> Array:
        """(k, ...) weighted sums of x (g, ...)."""
        out = self._table @ np.ascontiguousarray(x).reshape(len(x), -1)
        return np.asarray(out).reshape(-1, *x.shape[1:])


def _bell() -> tuple[Array, Array]:
    """Weights of w and of w'' on the grid; those of w sum to one."""
    x = np.arange(1, PER_KNOT * (DEGREE + 1)) / PER_KNOT
    w, bend = np.zeros_like(x), np.zeros_like(x)
    for k in range(DEGREE + 2):  # a sum of powers of what lies behind each knot
        behind, share = np.maximum(x - k, 0.0), (-1) ** k * math.comb(DEGREE + 1, k)
        w += share * behind**DEGREE
        bend += share * DEGREE * (DEGREE - 1) * behind ** (DEGREE - 2)
    return w / w.sum(), bend / (w.sum() * KNOT_S**2)


BELL, BEND = _bell()
# So many windows say as much of slow signals, in white noise, as one that stood by itself: they
# overlap, and what is common to neighbours counts once.
OVERLAP = float(1.0 / (PER_KNOT * np.sum(BELL**2)))
