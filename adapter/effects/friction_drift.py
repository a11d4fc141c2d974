"""Friction drift: Coulomb friction that changes by dFc each second, from the start on."""

from __future__ import annotations

from copy import copy

from adapter.effects.base import (
    Array,
    Motion,
    Parameter,
    TorqueEffect,
    Values,
    on_joint,
)
from adapter.effects.phrases import Phrase
from adapter.effects.splits import LATER, STILL

SLOWEST = 0.008  # N m/s
LONG_S, RISE_NM = 60.0, 0.16  # in a longer recording: what it rises by in all, as within 20 s


class FrictionDrift(TorqueEffect):
    """A gear that warms up."""

    name = "friction_drift"
    title = "friction drift"
    parameters = (Parameter("dFc", "N m/s"),)
    prior_std = 0.05
    log_odds = -5.0
    inexact = 0.03
    phrase = Phrase(
        "the friction of {who} rises by {x}", "dFc", "the friction of {who} falls by {x}"
    )
    shows = ((STILL, "fades or changes sign"), (LATER, "has gone on"))

    slowest = SLOWEST

    def over(self, seconds: float) -> FrictionDrift:
        """Over an hour much less shows than over a minute."""
        if seconds <= LONG_S:
            return self
        slower = copy(self)
        slower.slowest = RISE_NM / seconds
        return slower

    def possible(self, values: Values) -> bool:
        """What drifts more slowly is not told from a velocity signal that is not quite right."""
        return abs(float(values["dFc"])) > self.slowest

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """dFc t sign(dq), t since the effect began, or the recording."""
        column = motion.t * motion.direction[:, joint]
        return on_joint(motion, joint, float(values["dFc"]) * column)
