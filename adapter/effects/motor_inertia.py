"""Reflected rotor inertia ("armature"): tau = B ddq."""

from __future__ import annotations

from adapter.effects.base import Array


class MotorInertia:
    """Torque that speeds the joint's own rotor up, seen at the joint."""

    name = "motor_inertia"
    key = "B"
    unit = "kg m2"
    prior_std = 0.1  # a link-side sensor should see none; catalogue sizes are 0.05 to 0.3

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """ddq."""
        return ddq
