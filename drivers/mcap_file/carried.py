"""Sensors with stamps of their own, carried to the joint samples.

A message goes to the joint sample nearest in time, along the straight line through its neighbours;
of several that share a sample their mean does. Samples that no message is nearest to stay not a
number. So nothing is made up in gaps, and the noise of what is there stays that of the sensor,
which values interpolated at every sample would hide.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Array

LONGEST_PERIODS = 3.0  # of the sensor; no line is drawn across a longer silence
MENTIONED = 0.05  # share of messages outside the joint samples' time that is worth a sentence


class Carrier:
    """Carries sensors to the stamps of the joint samples and keeps what to say of it."""

    def __init__(self, stamp_ns: NDArray[np.int64], path: Path, warnings: list[str]) -> None:
        """Take (m,) stamps of the joint samples, ns; sentences go to `warnings`."""
        self._count = len(stamp_ns)
        self._onto, self._rows = np.unique(stamp_ns, return_index=True)
        self._path, self._warnings = path, warnings
        self._carried: dict[str, list[str]] = {}

    def carry(self, name: str, own_ns: NDArray[np.int64], values: Array) -> Array | None:
        """(m, 3 h) the values (k, 3 h) of a sensor at the joint samples, each vector by itself.

        None, with a warning, where no message lies within the joint samples' time.

        Args:
            name: of the sensor, for sentences.
            own_ns: (k,) stamps; values: vectors that are not a number are passed over.
        """
        own, first = np.unique(own_ns, return_index=True)
        near, close = _nearest(self._onto, own)
        if not close.any():
            self._warnings.append(
                f"{self._path}: {name}: its stamps ({_span(own)}) lie outside those of the joint "
                f"samples ({_span(self._onto)}); do they share a clock? Left out"
            )
            return None
        missed = len(own) - int(close.sum())
        if missed > MENTIONED * len(own):
            self._warnings.append(
                f"{self._path}: {name}: {missed} of {len(own)} messages are near no joint sample; "
                "left out"
            )
        out = np.full((self._count, values.shape[1]), np.nan)
        for k in range(0, values.shape[1], 3):
            x = values[first, k : k + 3]
            use = close & np.isfinite(x).all(axis=1)
            cells, moved = _moved(self._onto, own[use], near[use], x[use])
            out[self._rows[cells], k : k + 3] = moved
        self._carried.setdefault(_rate(own), []).append(name)
        return out

    def tell(self) -> None:
        """One sentence for all sensors of a rate."""
        for rate, names in self._carried.items():
            self._warnings.append(
                f"{self._path}: {', '.join(names)}: {rate}, carried to the joint samples' stamps"
            )


def _rate(own_ns: NDArray[np.int64]) -> str:
    if len(own_ns) < 2:
        return "one message"
    return f"{1e9 / float(np.median(np.diff(own_ns))):.0f} Hz"


def _span(stamp_ns: NDArray[np.int64]) -> str:
    return f"{1e-9 * stamp_ns[0]:.3f} to {1e-9 * stamp_ns[-1]:.3f} s"


def _nearest(
    onto: NDArray[np.int64], own: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """(k,) the nearest of the stamps `onto`, and whether it is no further than their period."""
    if len(onto) < 2:
        return np.zeros(len(own), dtype=np.int64), np.isin(own, onto)
    right = np.clip(np.searchsorted(onto, own), 1, len(onto) - 1)
    near = right - (own - onto[right - 1] < onto[right] - own)
    return near, np.abs(onto[near] - own) <= np.median(np.diff(onto))


def _moved(
    onto: NDArray[np.int64], own: NDArray[np.int64], near: NDArray[np.int64], x: Array
) -> tuple[NDArray[np.int64], Array]:
    """Places in `onto` (c,) that messages are nearest to, and their values (c, 3) there."""
    start = np.flatnonzero(np.diff(near, prepend=-1))
    if not start.size:
        return near, x
    count = np.diff(start, append=len(near))
    cells = near[start]
    early_s = 1e-9 * (own - onto[near]).astype(np.float64)
    off_s = np.add.reduceat(early_s, start) / count
    mean = np.add.reduceat(x, start, axis=0) / count[:, None]
    t_s = 1e-9 * (onto[cells] - onto[0]).astype(np.float64) + off_s
    return cells, mean - off_s[:, None] * _slopes(t_s, mean)


def _slopes(t_s: Array, x: Array) -> Array:
    """(c, 3) rates of change: the mean of those to either side, but not across a silence."""
    step = np.diff(t_s)
    if not step.size:
        return np.zeros_like(x)
    near = step <= LONGEST_PERIODS * np.median(step)
    rate = np.where(near[:, None], np.diff(x, axis=0) / step[:, None], 0.0)
    none = np.zeros((1, x.shape[1]))
    sides = np.concatenate([[0], near]) + np.concatenate([near, [0]])
    total = np.concatenate([none, rate]) + np.concatenate([rate, none])
    return np.asarray(total / np.maximum(sides, 1)[:, None])
