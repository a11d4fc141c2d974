"""Payload: a rigid body added to the last link, in that link's frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.base import BODY_STD, FLANGE, Array, BodyEffect, Parameter, Values
from adapter.effects.phrases import Phrase
from adapter.effects.splits import BARE
from adapter.model.inertia import body_from_theta, six_from_tensor, tensor_from_six, theta_from_body
from adapter.model.urdf_text import Additions


class Payload(BodyEffect):
    """Something that the last link carries: mass, centre and, where given, inertia about it."""

    name = "payload"
    title = "payload"
    scope = FLANGE
    parameters = (
        Parameter("m", "kg"),
        Parameter("cx", "m"),
        Parameter("cy", "m"),
        Parameter("cz", "m"),
        Parameter("inertia", "kg m2", count=6, optional=True),
    )
    prior_std = BODY_STD
    positive = ("m",)
    phrase = Phrase(
        "the flange carries {x}", "m", "the flange carries {x} less than the model says"
    )
    shows = ((BARE, "is gone"),)
    sudden = True
    watched = True
    is_theta = True

    def decode(self, x: Array) -> dict[str, Any]:
        """Of ten inertial parameters."""
        return parameters_of(x)

    def body(self, theta: Array, gravity: Array, joint: int, values: Values) -> tuple[Array, Array]:
        """The last link with the body."""
        changed = theta.copy()
        changed[-1] += theta_of(values)
        return changed, gravity

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """A body of its own where it can be one."""
        alone = more.carry(theta_of(values))
        return None if alone else "it has no inertia that could be a body's; the last link has it"


def theta_of(values: Values) -> Array:
    """Ten parameters (10,) of a payload about the link's origin."""
    com = np.array([values["cx"], values["cy"], values["cz"]], dtype=float)
    tensor = tensor_from_six(np.asarray(values.get("inertia", np.zeros(6)), dtype=float))
    return np.asarray(theta_from_body(float(values["m"]), com, tensor))


def parameters_of(theta: Array) -> dict[str, Any]:
    """Payload parameters of ten inertial ones (10,)."""
    m, com, tensor = body_from_theta(theta)
    keys = dict(zip(("cx", "cy", "cz"), map(float, com), strict=True))
    return {"m": float(m), **keys, "inertia": [float(x) for x in six_from_tensor(tensor)]}
