"""Asymmetric Coulomb friction: Fc_pos for dq > 0, Fc_neg for dq < 0, both opposing motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from adapter.effects.base import (
    Array,
    JointTorque,
    Parameter,
    Template,
    Values,
    smooth_sign,
)


class AsymmetricFriction(JointTorque):
    """Coulomb friction of another size in either direction."""

    name = "asymmetric_friction"
    title = "asymmetric friction"
    parameters = (Parameter("Fc_pos", "N m"), Parameter("Fc_neg", "N m"))
    positive = ("Fc_pos", "Fc_neg")
    log_odds = -3.0  # Coulomb friction and an offset say the same in simpler words
    inexact = 0.02
    simpler: ClassVar[Mapping[str, float]] = {
        "coulomb_friction": 10.0,
        "load_dependent_friction": 10.0,
    }
    split_by = (
        "hold the joint still after moving in either direction: an offset stays, friction fades"
    )

    def templates(self) -> tuple[Template, ...]:
        """Both sizes."""
        return (Template((1.0, 1.0), lambda x: {"Fc_pos": float(x[0]), "Fc_neg": float(x[1])}),)

    def law(
        self,
        q: Array,
        dq: Array,
        ddq: Array,
        tau: Array,
        values: Values,
        smoothing_s: float = 0.0,
    ) -> Array:
        """Fc_pos where dq > 0, -Fc_neg where dq < 0, smoothed around rest."""
        sign = smooth_sign(dq, ddq, smoothing_s)
        return np.asarray(np.where(sign > 0.0, values["Fc_pos"], values["Fc_neg"]) * sign)
