"""Torque sensor offset: tau_measured = tau + o."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array


class TorqueOffset:
    """A constant that the joint's torque sensor adds."""

    name = "torque_offset"
    key = "o"
    unit = "N m"
    prior_std = 1.0

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """One."""
        return np.ones_like(dq)
