"""How well an arm followed its reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.records import Array


class ErrorTally:
    """Square sum and maximum of the tracking error by joint."""

    def __init__(self, n: int) -> None:
        self.count, self._square, self._max = 0, np.zeros(n), np.zeros(n)

    def add(self, error: Array) -> None:
        """Count one error (n,), rad."""
        self.count += 1
        self._square += error * error
        np.maximum(self._max, np.abs(error), out=self._max)

    def as_dict(self) -> dict[str, Any]:
        """Samples, rms and max by joint in rad; None where nothing was counted."""
        if not self.count:
            return {"samples": 0, "rms_rad": None, "max_rad": None}
        rms = np.sqrt(self._square / self.count)
        return {"samples": self.count, "rms_rad": rms.tolist(), "max_rad": self._max.tolist()}
