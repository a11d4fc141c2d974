"""Viscous friction: tau = Fv dq. Positive Fv opposes motion."""

from __future__ import annotations

from adapter.effects.base import Array


class ViscousFriction:
    """Friction torque in proportion to the joint's speed."""

    name = "viscous_friction"
    key = "Fv"
    unit = "N m s/rad"
    prior_std = 1.0  # published Panda values are 0.03 to 0.09 (Knezevic)

    def column(self, q: Array, dq: Array, ddq: Array, smoothing_s: float = 0.0) -> Array:
        """dq."""
        return dq
