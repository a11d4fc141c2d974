"""Torque sensor offset: tau_measured = tau + o."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array, LinearEffect, Parameter


class TorqueOffset(LinearEffect):
    """A constant that the joint's torque sensor adds."""

    name = "torque_offset"
    title = "torque sensor offset"
    parameters = (Parameter("o", "N m"),)
    prior_std = 1.0
    typical = 0.5
    split_by = "move the joint over a wider range, or read the sensor with the base rotated"

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """One."""
        return np.ones_like(dq)
