"""Torque sensor offset: tau_measured = tau + o."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array, LinearEffect, Parameter
from adapter.effects.phrases import Phrase


class TorqueOffset(LinearEffect):
    """A constant that the joint's torque sensor adds."""

    name = "torque_offset"
    title = "torque sensor offset"
    parameters = (Parameter("o", "N m"),)
    prior_std = 1.0
    phrase = Phrase(
        "the torque sensor of {who} reads {x} too much",
        "o",
        "the torque sensor of {who} reads {x} too little",
    )
    after_sensors = True  # whatever else the sensors do
    sudden = True
    watched = True
    bundled = True

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """One."""
        return np.ones_like(dq)
