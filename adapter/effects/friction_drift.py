"""Friction drift: Coulomb friction that changes by dFc each second, from the start on."""

from __future__ import annotations

from adapter.effects.base import (
    Array,
    Motion,
    Parameter,
    TorqueEffect,
    Values,
    on_joint,
    smooth_sign,
)

SLOWEST = 0.008  # N m/s


class FrictionDrift(TorqueEffect):
    """A gear that warms up."""

    name = "friction_drift"
    title = "friction drift"
    parameters = (Parameter("dFc", "N m/s"),)
    typical = 0.05
    log_odds = -5.0
    inexact = 0.03
    split_by = "repeat the motion after the arm has moved for ten minutes"

    def possible(self, values: Values) -> bool:
        """What drifts more slowly is not told from a velocity signal that is not quite right."""
        return abs(float(values["dFc"])) > SLOWEST

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """dFc t sign(dq), t since the effect began, or the recording."""
        column = motion.t * smooth_sign(motion.dq[:, joint])
        return on_joint(motion, joint, float(values["dFc"]) * column)
