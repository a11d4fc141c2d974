"""Torque ripple: a sin(n q + phase), n a whole number per turn."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from adapter.effects.base import (
    Array,
    JointSignals,
    JointTorque,
    Parameter,
    Template,
    Values,
    polar,
)
from adapter.effects.law import LOG_ODDS
from adapter.effects.phrases import Phrase
from adapter.effects.splits import TURN

# Harmonic drives and motors give 1, 2, 4 and the numbers of poles and rollers.
NUMBERS = tuple(range(1, 31))


class TorqueRipple(JointTorque):
    """A torque that repeats with the joint's angle."""

    name = "torque_ripple"
    title = "torque ripple"
    parameters = (
        Parameter("a", "N m"),
        Parameter("n", "per turn", lower=0.0),
        Parameter("phase", "rad"),
    )
    inexact = 0.01
    phrase = Phrase("{who} {has} a torque ripple of {a}, {n}")
    shows = ((TURN, "repeats along the turn"),)
    over_angle = True

    def templates(self) -> tuple[Template, ...]:
        """Sine and cosine of each number per turn."""
        return tuple(Template((0.3, 0.3), partial(_decode, n), f"n = {n}") for n in NUMBERS)

    def log_odds_over(self, values: Values, turned: float) -> float:
        """Less than a whole wave may be any curve over the angle, which has no name."""
        return 0.0 if values["n"] * turned > 2.0 * np.pi else LOG_ODDS

    def law(self, at: JointSignals, values: Values) -> Array:
        """a sin(n q + phase)."""
        return np.asarray(values["a"] * np.sin(values["n"] * at.q + values["phase"]))


def _decode(n: int, x: Array) -> dict[str, Any]:
    size, phase = polar(x)
    return {"a": size, "n": float(n), "phase": phase}
