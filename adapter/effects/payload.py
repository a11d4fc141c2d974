"""Payload: a rigid body added to the last link, in that link's frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.base import FLANGE, Array, BodyEffect, Parameter, Template, Values
from adapter.inertia import body_from_theta, six_from_tensor, tensor_from_six, theta_from_body


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
    positive = ("m",)
    split_by = "weigh the last link apart, or repeat the motion with the tool taken off"

    def templates(self) -> tuple[Template, ...]:
        """Ten inertial parameters."""
        sizes = (1.0, 0.1, 0.1, 0.1, *(0.03 * np.ones(6)))
        return (Template(tuple(map(float, sizes)), parameters_of),)

    def body(self, theta: Array, gravity: Array, joint: int, values: Values) -> tuple[Array, Array]:
        """The last link with the body."""
        changed = theta.copy()
        changed[-1] += theta_of(values)
        return changed, gravity


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
