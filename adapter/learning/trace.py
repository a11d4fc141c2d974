"""A record of how something developed, in a fixed amount of memory."""

from __future__ import annotations

import numpy as np

from adapter.model.spatial import Array


class Trace:
    """Rows over time at a stride that doubles whenever the space is full.

    Args:
        width: numbers per row.
        stride: offers per kept row, at first.
        capacity: rows; even.
    """

    def __init__(self, width: int, stride: int = 10, capacity: int = 6000) -> None:
        self._rows = np.full((capacity, width), np.nan)
        self._used = 0
        self._offers = 0
        self.stride = stride

    def due(self, offers: int = 1) -> range:
        """Count so many offers; which of them, from 0, are to be kept."""
        due = range(-self._offers % self.stride, offers, self.stride)
        self._offers += offers
        return due

    def keep(self, *parts: Array | float) -> None:
        """Keep one row, given in parts."""
        if self._used == len(self._rows):
            half = self._rows[::2].copy()
            self._rows[: len(half)] = half
            self._used, self.stride = len(half), 2 * self.stride
        self._rows[self._used] = np.concatenate(parts, axis=None)
        self._used += 1

    @property
    def rows(self) -> Array:
        """(k, width) what was kept, oldest first."""
        return self._rows[: self._used]
