"""Viscous friction: tau = Fv dq. Positive Fv opposes motion."""

from __future__ import annotations

from adapter.effects.base import Array, LinearEffect, Parameter


class ViscousFriction(LinearEffect):
    """Friction torque in proportion to the joint's speed."""

    name = "viscous_friction"
    title = "viscous friction"
    parameters = (Parameter("Fv", "N m s/rad"),)
    prior_std = 1.0  # published Panda values are 0.03 to 0.09 (Knezevic)
    typical = 0.5
    positive = ("Fv",)
    inexact = 0.02
    split_by = "move the joint at several constant speeds, slow to fast, over the same range"

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """dq."""
        return dq
