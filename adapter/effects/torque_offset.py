"""Torque sensor offset: tau_measured = tau + o."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array, JointSignals, LinearEffect, Parameter
from adapter.effects.phrases import Phrase


class TorqueOffset(LinearEffect):
    """A constant that the joint's torque sensor adds."""

    name = "torque_offset"
    title = "torque sensor offset"
    parameters = (Parameter("o", "N m"),)
    prior_std = 1.0
    phrase = Phrase.reads("o", "torque sensor")
    after_sensors = True  # whatever else the sensors do
    sudden = True
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """One."""
        return np.ones_like(at.dq)
