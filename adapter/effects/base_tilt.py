"""Base tilt: the base turned by the rotation vector [rx, ry, 0] in base axes."""

from __future__ import annotations

import math

import numpy as np

from adapter.effects.base import BASE, Array, BodyEffect, Parameter, Values
from adapter.effects.phrases import Length, Phrase
from adapter.effects.splits import LEVELLED, LOADS
from adapter.model.spatial import exp_rotation
from adapter.model.urdf_text import NO_PLACE, Additions


class BaseTilt(BodyEffect):
    """A base that does not stand as the model says: gravity in the base is R(r)^T g."""

    name = "base_tilt"
    title = "base tilt"
    scope = BASE
    parameters = (Parameter("rx", "rad"), Parameter("ry", "rad"))
    prior_std = (0.03, 0.03)
    phrase = Phrase(
        "the base is tilted by {length}",
        lengths=(Length(("rx", "ry"), "°", 180.0 / math.pi, name="tilt"),),
    )
    shows = ((LOADS, "grows with the load"), (LEVELLED, "shows"))

    def body(self, theta: Array, gravity: Array, joint: int, values: Values) -> tuple[Array, Array]:
        """Gravity seen from the tilted base."""
        return theta, np.asarray(self.turn(values).T @ gravity)

    @staticmethod
    def turn(values: Values) -> Array:
        """Orientation (3, 3) of the base against one that stands as the model says."""
        return exp_rotation([float(values["rx"]), float(values["ry"]), 0.0])

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """A base that stands on an upright link."""
        if more.floating:
            return NO_PLACE
        turn = self.turn(values)
        more.tilt = turn if more.tilt is None else more.tilt @ turn
        return None
