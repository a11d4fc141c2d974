"""Coulomb friction: tau = Fc sign(dq), smoothed around rest. Positive Fc opposes motion."""

from __future__ import annotations

from adapter.effects.base import Array, LinearEffect, Parameter, smooth_sign


class CoulombFriction(LinearEffect):
    """Friction torque that depends on the direction of motion alone."""

    name = "coulomb_friction"
    title = "Coulomb friction"
    parameters = (Parameter("Fc", "N m"),)
    prior_std = 1.0  # published Panda values are 0.2 to 0.5 (Knezevic)
    typical = 1.0
    positive = ("Fc",)
    inexact = 0.02
    split_by = "repeat the motion with a ladder of loads at the flange, at the same speed"

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """tanh(dq / w) with w = 0.01 rad/s, or as far as dq goes within the smoothing time."""
        return smooth_sign(dq, ddq, smoothing_s)
