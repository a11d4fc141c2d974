"""Coulomb friction: tau = Fc sign(dq), smoothed around rest. Positive Fc opposes motion."""

from __future__ import annotations

from adapter.effects.base import LEVEL, Array, JointSignals, LinearEffect, Parameter
from adapter.effects.phrases import Phrase
from adapter.effects.splits import STILL, TURNS
from adapter.model.urdf_text import FRICTION


class CoulombFriction(LinearEffect):
    """Friction torque that depends on the direction of motion alone."""

    name = "coulomb_friction"
    title = "Coulomb friction"
    parameters = (Parameter("Fc", "N m"),)
    prior_std = 1.0  # published Panda values are 0.2 to 0.5 (Knezevic)
    place = FRICTION
    positive = ("Fc",)
    inexact = 0.02
    band = 0.3  # static friction is 1 to 1.6 times Coulomb's in what is published
    phrase = Phrase.lacks("Fc", "Coulomb friction")
    form = LEVEL
    shows = ((STILL, "fades or changes sign"), (TURNS, "turns over at once"))
    sudden = True
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """tanh(dq / w) with w = 0.01 rad/s, or as far as dq goes within the smoothing time."""
        return at.direction
