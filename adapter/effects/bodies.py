"""Inertias and gravity that are not the model's, and what pushes the flange."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from adapter.effects import base as base
from adapter.effects.base import Array, Motion, Values
from adapter.effects.phrases import ALONE, BARE, LEVELLED, LOADS, WEIGHED, Length, Phrase
from adapter.model.inertia import body_from_theta, six_from_tensor, tensor_from_six, theta_from_body
from adapter.model.spatial import exp_rotation
from adapter.model.urdf_text import NO_PLACE, Additions


class Payload(base.BodyEffect):
    """A rigid body that the last link carries, in that link's frame.

    Mass, centre and, where given, inertia about it.
    """

    name = "payload"
    title = "payload"
    scope = base.FLANGE
    parameters = (
        base.Parameter("m", "kg"),
        base.Parameter("cx", "m"),
        base.Parameter("cy", "m"),
        base.Parameter("cz", "m"),
        base.Parameter("inertia", "kg m2", count=6, optional=True),
    )
    prior_std = base.BODY_STD
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


class LinkInertia(base.BodyEffect):
    """A link that weighs something else: its θ differs by dtheta (order of eq. 4b)."""

    name = "link_inertia"
    title = "wrong link inertia"
    scope = base.LINK
    parameters = (base.Parameter("dtheta", "kg, kg m, kg m2", count=10),)
    prior_std = base.BODY_STD
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


class BaseTilt(base.BodyEffect):
    """A base that does not stand as the model says: gravity in the base is R(r)^T g.

    r is the rotation vector [rx, ry, 0] in base axes.
    """

    name = "base_tilt"
    title = "base tilt"
    scope = base.BASE
    parameters = (base.Parameter("rx", "rad"), base.Parameter("ry", "rad"))
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


KEYS = ("fx", "fy", "fz", "mx", "my", "mz")


def _wrench(values: Values) -> Array:
    return np.array([values[key] for key in KEYS], dtype=float)


class ExternalWrench(base.TorqueEffect):
    """A constant wrench w that pushes the flange for a time: tau_measured = tau_rigid - J^T w.

    At the origin of the last link, base axes.
    """

    name = "external_wrench"
    title = "external wrench"
    scope = base.FLANGE
    parameters = tuple(base.Parameter(key, "N" if key in KEYS[:3] else "N m") for key in KEYS)
    prior_std = (15.0, 15.0, 15.0, 2.0, 2.0, 2.0)
    inexact = 0.05
    phrase = Phrase(
        "something pushes the flange with {length}",
        lengths=(Length(KEYS[:3], "N"), Length(KEYS[3:], "N m", before="a moment of ")),
    )
    shows = ((ALONE, "is gone"),)
    sudden = True
    passing = True
    watched = True
    instant = "wrench", _wrench

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """-J^T w."""
        return -motion.arm.wrench_torque(motion.q, _wrench(values))
