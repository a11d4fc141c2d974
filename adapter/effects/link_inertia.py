"""Link inertia: theta of one link differs from the model by dtheta (order of eq. 4b)."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.base import BODY_STD, LINK, Array, BodyEffect, Parameter, Values
from adapter.effects.phrases import Phrase
from adapter.effects.splits import WEIGHED
from adapter.model.urdf_text import Additions


class LinkInertia(BodyEffect):
    """A link that weighs something else than the model says."""

    name = "link_inertia"
    title = "wrong link inertia"
    scope = LINK
    parameters = (Parameter("dtheta", "kg, kg m, kg m2", count=10),)
    prior_std = BODY_STD
    log_odds = -2.0
    phrase = Phrase("{who} {has} other inertias than the model says ({torque})")
    shows = ((WEIGHED, "shows"),)
    steady = True  # what a link gains while it moves is a load
    is_theta = True

    def decode(self, x: Array) -> dict[str, Any]:
        """Of ten inertial parameters."""
        return {"dtheta": [float(value) for value in x]}

    def body(self, theta: Array, gravity: Array, joint: int, values: Values) -> tuple[Array, Array]:
        """Link `joint` with its change."""
        changed = theta.copy()
        changed[joint] += np.asarray(values["dtheta"], dtype=float)
        return changed, gravity

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """Part of the link."""
        more.dtheta[joint] += np.asarray(values["dtheta"], dtype=float)
        return None
