"""Load-dependent friction: Fl |tau| sign(dq), tau the rigid torque of the joint."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import (
    Array,
    JointTorque,
    Parameter,
    Values,
    smooth_sign,
)


class LoadDependentFriction(JointTorque):
    """Friction in proportion to the torque that the gear carries."""

    name = "load_dependent_friction"
    title = "load-dependent friction"
    parameters = (Parameter("Fl", "1"),)
    typical = 0.05
    positive = ("Fl",)
    log_odds = -1.0
    inexact = 0.03
    split_by = "repeat the motion with a ladder of loads at the flange, at the same speed"

    def law(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        tau: Array,
        values: Values,
        smoothing_s: float = 0.0,
    ) -> Array:
        """Fl |tau| sign(dq)."""
        return np.asarray(values["Fl"] * np.abs(tau) * smooth_sign(dq, ddq, smoothing_s))
