"""Viscous friction: tau = Fv dq. Positive Fv opposes motion."""

from __future__ import annotations

from adapter.effects.base import Array, JointSignals, LinearEffect, Parameter
from adapter.effects.phrases import Phrase
from adapter.effects.splits import SPEEDS, STILL
from adapter.model.urdf_text import DAMPING


class ViscousFriction(LinearEffect):
    """Friction torque in proportion to the joint's speed."""

    name = "viscous_friction"
    title = "viscous friction"
    parameters = (Parameter("Fv", "N m s/rad"),)
    prior_std = 1.0  # published Panda values are 0.03 to 0.09 (Knezevic)
    place = DAMPING
    positive = ("Fv",)
    inexact = 0.02
    phrase = Phrase.lacks("Fv", "viscous friction")
    shows = ((SPEEDS, "rises in proportion to the speed"), (STILL, "is gone"))
    sudden = True
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """dq."""
        return at.dq
