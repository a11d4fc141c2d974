"""Coulomb friction: tau = Fc sign(dq), smoothed around rest. Positive Fc opposes motion."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array

SMOOTHING_DQ = 0.01  # rad/s; below it the sign of a filtered velocity is noise


class CoulombFriction:
    """Friction torque that depends on the direction of motion alone."""

    name = "coulomb_friction"
    key = "Fc"
    unit = "N m"
    prior_std = 1.0  # published Panda values are 0.2 to 0.5 (Knezevic)

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """tanh(dq / w) with w = 0.01 rad/s, or as far as dq goes within the smoothing time."""
        if not smoothing_s:
            return np.tanh(dq / SMOOTHING_DQ)
        return np.tanh(dq / np.hypot(SMOOTHING_DQ, smoothing_s * ddq))
