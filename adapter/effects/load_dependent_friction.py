"""Load-dependent friction: Fl |tau| sign(dq), tau the rigid torque of the joint."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import LEVEL_BY_LOAD, Array, JointSignals, LinearEffect, Parameter
from adapter.effects.phrases import Phrase
from adapter.effects.splits import LOADS, STILL


class LoadDependentFriction(LinearEffect):
    """Friction in proportion to the torque that the gear carries."""

    name = "load_dependent_friction"
    title = "load-dependent friction"
    parameters = (Parameter("Fl", "1"),)
    prior_std = 0.05
    positive = ("Fl",)
    log_odds = -1.0
    inexact = 0.03
    phrase = Phrase(
        "{who} {lacks} friction of {x} of its load",
        "Fl",
        "{who} {has} less friction than the model says, by {x} of its load",
    )
    form = LEVEL_BY_LOAD
    by_load = True
    shows = ((LOADS, "grows with the load"), (STILL, "fades or changes sign"))

    def column(self, at: JointSignals) -> Array:
        """|tau| sign(dq)."""
        return np.asarray(np.abs(at.tau) * at.direction)
