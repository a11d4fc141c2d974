"""Stribeck friction: (Fc + (Fs - Fc) exp(-(dq/vs)^2)) sign(dq), or z of bristles for the sign.

With bristles it is LuGre's friction without damping (Canudas de Wit et al., A New Model for Control
of Systems with Friction, 1995), their stiffness being that of the level at which they slide.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adapter.effects.base import (
    LEVEL,
    TWO_LEVELS,
    Array,
    JointSignals,
    Parameter,
    Template,
    Values,
)
from adapter.effects.bristle_friction import USUAL_RAD, WAY, Rubs, log_odds_of_way
from adapter.effects.by_joint import WAYS_RAD, shares_of_ways
from adapter.effects.phrases import Phrase
from adapter.effects.splits import SPEEDS, STILL
from adapter.model.urdf_text import FRICTION, Additions

VELOCITIES = (0.03, 0.06, 0.12, 0.25)  # rad/s, tried for vs
SCALE = Parameter("vs", "rad/s", lower=1e-3, upper=10.0, grid_share=0.03)


class StribeckFriction(Rubs):
    """Friction that falls from Fs at rest to Fc in motion, and may wind up over a way before."""

    name = "stribeck_friction"
    title = "Stribeck friction"
    parameters = (
        Parameter("Fc", "N m"),
        Parameter("Fs", "N m"),
        SCALE,
        replace(WAY, optional=True),
    )
    positive = ("Fc", "Fs")
    log_odds = -3.0
    inexact = 0.03
    simpler = ((LEVEL, 0.01), (TWO_LEVELS, 0.01))
    phrase = Phrase("{who} {lacks} Stribeck friction of {Fs} at rest and {Fc} in motion")
    shows = ((SPEEDS, "falls as the joint gets faster"), (STILL, "fades or changes sign"))

    def templates(self) -> tuple[Template, ...]:
        """Both levels at several velocity scales, without bristles and with."""
        return tuple(_template(vs, s0) for s0 in (None, USUAL_RAD) for vs in VELOCITIES)

    def reshaped(self, values: Values, ratio: float) -> tuple[Template, ...]:
        """Another vs, another s0."""
        vs, s0 = float(values["vs"]), self.bristles(values)
        other = _template(SCALE.nearest(ratio * vs), s0)
        return (other,) if s0 is None else (other, _template(vs, WAY.nearest(ratio * s0)))

    def log_odds_of(self, values: Values) -> float:
        """As of bristles."""
        s0 = self.bristles(values)
        return 0.0 if s0 is None else log_odds_of_way(s0)

    def possible(self, values: Values) -> bool:
        """Friction that falls with speed, all of it positive."""
        return 0.0 < float(values["Fc"]) < float(values["Fs"])

    def level(self, dq: Array, values: Values) -> Array:
        """The Stribeck curve."""
        level, rest, vs = (values[key] for key in ("Fc", "Fs", "vs"))
        return np.asarray(level + (rest - level) * np.exp(-((dq / vs) ** 2)))

    def law(self, at: JointSignals, values: Values) -> Array:
        """The curve times z, where there is a way over which bristles are known to be bent."""
        z, s0 = at.direction, values.get("s0", WAY.lower)
        if np.max(s0) > WAYS_RAD[0]:
            bent = sum(x * y for x, y in zip(shares_of_ways(s0), at.bent, strict=True))
            z = np.where(s0 > WAYS_RAD[0], bent, z)
        return np.asarray(self.level(at.dq, values) * z)

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """What stays in motion, as dry friction."""
        return more.at_joint(FRICTION, joint, values["Fc"], "Fc is there as the joint's friction")


def _template(vs: float, s0: float | None = None) -> Template:
    fixed = {"vs": vs} if s0 is None else {"vs": vs, "s0": s0}

    def decode(x: Array) -> dict[str, Any]:
        return {"Fc": float(x[0]), "Fs": float(x[1]), **fixed}

    said = "" if s0 is None else f", s0 = {s0:.3g} rad"
    return Template((1.0, 1.0), decode, f"vs = {vs:.3g} rad/s{said}")
