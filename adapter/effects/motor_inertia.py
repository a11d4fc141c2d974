"""Reflected rotor inertia ("armature"): tau = B ddq."""

from __future__ import annotations

from adapter.effects.base import Array, LinearEffect, Parameter


class MotorInertia(LinearEffect):
    """Torque that speeds the joint's own rotor up, seen at the joint."""

    name = "motor_inertia"
    title = "reflected motor inertia"
    parameters = (Parameter("B", "kg m2"),)
    prior_std = 0.1  # a link-side sensor should see none; catalogue sizes are 0.05 to 0.3
    typical = 0.15
    positive = ("B",)
    split_by = "repeat the motion in postures with another load inertia about this joint"

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """ddq."""
        return ddq
