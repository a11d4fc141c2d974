"""Reflected rotor inertia ("armature"): tau = B ddq."""

from __future__ import annotations

from adapter.effects.base import Array, JointSignals, LinearEffect, Parameter
from adapter.effects.phrases import Phrase
from adapter.effects.splits import SPEEDS, STILL
from adapter.model.urdf_text import ARMATURE


class MotorInertia(LinearEffect):
    """Torque that speeds the joint's own rotor up, seen at the joint."""

    name = "motor_inertia"
    title = "reflected motor inertia"
    parameters = (Parameter("B", "kg m2"),)
    prior_std = 0.1  # a link-side sensor should see none; catalogue sizes are 0.05 to 0.3
    place = ARMATURE  # which MJCF has and URDF has not
    positive = ("B",)
    phrase = Phrase.lacks("B", "reflected motor inertia")
    shows = ((SPEEDS, "is gone"), (STILL, "is gone"))
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """ddq."""
        return at.ddq
