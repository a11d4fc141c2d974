"""What was shown before, so that a page that comes late or comes back shows the whole run."""

from __future__ import annotations

from collections import deque

FAST_ROWS, SLOW_ROWS = 400, 240  # that are kept


class Recent:
    """The last rows, encoded.

    Args:
        rows: that are kept.
    """

    def __init__(self, rows: int = FAST_ROWS) -> None:
        self._rows: deque[bytes] = deque(maxlen=rows)

    def add(self, row: bytes) -> None:
        """Keep one; the oldest goes."""
        self._rows.append(row)

    def rows(self) -> list[bytes]:
        """All that are kept, oldest first."""
        return list(self._rows)


class Whole:
    """Rows over the whole run, at ever longer distances in time.

    Args:
        rows: that are kept at most; where they get too many, every other one goes.
        every_s: the first distance.
    """

    def __init__(self, rows: int = SLOW_ROWS, every_s: float = 0.25) -> None:
        self._most, self._every_s = rows, every_s
        self._rows: list[bytes] = []
        self._due_s = -float("inf")

    def add(self, t_s: float, row: bytes) -> bool:
        """Keep the row of this time if it is due; whether it was."""
        if t_s < self._due_s:
            return False
        self._rows.append(row)
        if len(self._rows) >= self._most:
            del self._rows[1::2]
            self._every_s *= 2.0
        self._due_s = t_s + self._every_s
        return True

    def rows(self) -> list[bytes]:
        """All that are kept, oldest first."""
        return list(self._rows)
