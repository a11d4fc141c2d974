"""Asymmetric Coulomb friction: Fc_pos for dq > 0, Fc_neg for dq < 0, both opposing motion."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import (
    LEVEL,
    LEVEL_BY_LOAD,
    TWO_LEVELS,
    Array,
    JointSignals,
    JointTorque,
    Parameter,
    Values,
)
from adapter.effects.phrases import Phrase
from adapter.effects.splits import BOTH_WAYS, STILL
from adapter.model.urdf_text import FRICTION, Additions


class AsymmetricFriction(JointTorque):
    """Coulomb friction of another size in either direction."""

    name = "asymmetric_friction"
    title = "asymmetric friction"
    parameters = (Parameter("Fc_pos", "N m"), Parameter("Fc_neg", "N m"))
    prior_std = (1.0, 1.0)
    positive = ("Fc_pos", "Fc_neg")
    log_odds = -3.0  # Coulomb friction and an offset say the same in simpler words
    inexact = 0.02
    simpler = ((LEVEL, 10.0), (LEVEL_BY_LOAD, 10.0))
    phrase = Phrase("{who} {lacks} Coulomb friction of {Fc_pos} forwards and {Fc_neg} backwards")
    form = TWO_LEVELS
    shows = ((STILL, "fades or changes sign"), (BOTH_WAYS, "is larger one way than the other"))

    def law(self, at: JointSignals, values: Values) -> Array:
        """Fc_pos where dq > 0, -Fc_neg where dq < 0, smoothed around rest."""
        sign = at.direction
        return np.asarray(np.where(sign > 0.0, values["Fc_pos"], values["Fc_neg"]) * sign)

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """The mean, as dry friction."""
        mean = 0.5 * (values["Fc_pos"] + values["Fc_neg"])
        return more.at_joint(FRICTION, joint, mean, "the mean of both is there as friction")
