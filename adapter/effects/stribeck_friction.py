"""Stribeck friction: (Fc + (Fs - Fc) exp(-(dq/vs)^2)) sign(dq)."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.base import (
    LEVEL,
    TWO_LEVELS,
    Array,
    JointSignals,
    JointTorque,
    Parameter,
    Template,
    Values,
)
from adapter.effects.phrases import Phrase
from adapter.effects.splits import SPEEDS, STILL
from adapter.model.urdf_text import FRICTION, Additions

VELOCITIES = (0.03, 0.06, 0.12, 0.25)  # rad/s, tried for vs
SCALE = Parameter("vs", "rad/s", lower=1e-3, upper=10.0, grid_share=0.03)


class StribeckFriction(JointTorque):
    """Friction that falls from Fs at rest to Fc in motion."""

    name = "stribeck_friction"
    title = "Stribeck friction"
    parameters = (Parameter("Fc", "N m"), Parameter("Fs", "N m"), SCALE)
    positive = ("Fc", "Fs")
    log_odds = -3.0
    inexact = 0.03
    simpler = ((LEVEL, 0.01), (TWO_LEVELS, 0.01))
    phrase = Phrase("{who} {lacks} Stribeck friction of {Fs} at rest and {Fc} in motion")
    shows = ((SPEEDS, "falls as the joint gets faster"), (STILL, "fades or changes sign"))

    def templates(self) -> tuple[Template, ...]:
        """Both levels at several velocity scales."""
        return tuple(map(_template, VELOCITIES))

    def reshaped(self, values: Values, ratio: float) -> Template | None:
        """Another vs."""
        return _template(SCALE.nearest(ratio * float(values["vs"])))

    def possible(self, values: Values) -> bool:
        """Friction that falls with speed, all of it positive."""
        return 0.0 < float(values["Fc"]) < float(values["Fs"])

    def law(self, at: JointSignals, values: Values) -> Array:
        """The Stribeck curve."""
        level, rest, vs = (values[key] for key in ("Fc", "Fs", "vs"))
        curve = level + (rest - level) * np.exp(-((at.dq / vs) ** 2))
        return np.asarray(curve * at.direction)

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """What stays in motion, as dry friction."""
        return more.at_joint(FRICTION, joint, values["Fc"], "Fc is there as the joint's friction")


def _template(vs: float) -> Template:
    def decode(x: Array) -> dict[str, Any]:
        return {"Fc": float(x[0]), "Fs": float(x[1]), "vs": vs}

    return Template((1.0, 1.0), decode, f"vs = {vs:.3g} rad/s")
