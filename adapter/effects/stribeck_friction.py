"""Stribeck friction: (Fc + (Fs - Fc) exp(-(dq/vs)^2)) sign(dq)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np

from adapter.effects.base import (
    Array,
    JointTorque,
    Parameter,
    Template,
    Values,
    smooth_sign,
)

VELOCITIES = (0.03, 0.06, 0.12, 0.25)  # rad/s, tried for vs


class StribeckFriction(JointTorque):
    """Friction that falls from Fs at rest to Fc in motion."""

    name = "stribeck_friction"
    title = "Stribeck friction"
    parameters = (
        Parameter("Fc", "N m"),
        Parameter("Fs", "N m"),
        Parameter("vs", "rad/s", lower=1e-3, upper=10.0),
    )
    positive = ("Fc", "Fs")
    log_odds = -3.0
    inexact = 0.03
    simpler: ClassVar[Mapping[str, float]] = {"coulomb_friction": 0.01, "asymmetric_friction": 0.01}
    split_by = "move the joint at constant speeds from 0.01 to 0.5 rad/s"

    def templates(self) -> tuple[Template, ...]:
        """Both levels at several velocity scales."""
        return tuple(
            Template((1.0, 1.0), partial(_decode, vs), f"vs = {vs:g} rad/s") for vs in VELOCITIES
        )

    def reshaped(self, values: Values, ratio: float) -> Template | None:
        """Another vs."""
        vs = ratio * float(values["vs"])
        return Template((1.0, 1.0), partial(_decode, vs), f"vs = {vs:.3g} rad/s")

    def possible(self, values: Values) -> bool:
        """Friction that falls with speed, all of it positive."""
        return 0.0 < float(values["Fc"]) < float(values["Fs"])

    def law(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        tau: Array,
        values: Values,
        smoothing_s: float = 0.0,
    ) -> Array:
        """The Stribeck curve."""
        level, rest, vs = (values[key] for key in ("Fc", "Fs", "vs"))
        curve = level + (rest - level) * np.exp(-((dq / vs) ** 2))
        return np.asarray(curve * smooth_sign(dq, ddq, smoothing_s))


def _decode(vs: float, x: Array) -> dict[str, Any]:
    return {"Fc": float(x[0]), "Fs": float(x[1]), "vs": vs}
