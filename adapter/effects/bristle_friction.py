"""Friction that may wind up over a small way before the joint slides, by Dahl and by LuGre."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import cast

import numpy as np

from adapter.effects import base
from adapter.effects.base import Array, JointSignals, Motion, Values
from adapter.effects.by_joint import WAYS_RAD, shares_of_ways
from adapter.effects.phrases import SPEEDS, STILL, TURNS, Phrase
from adapter.model.urdf_text import BREAKAWAY, FRICTION, Additions

USUAL_RAD, TIMES = 1.5e-3, 3.0  # and by what factor it is off: a real Panda, a KUKA LWR4
WAY = base.Parameter("s0", "rad", lower=1e-6, upper=0.3, grid_share=0.1)
MAYBE_WAY = replace(WAY, optional=True)
VELOCITIES = (0.03, 0.06, 0.12, 0.25)  # rad/s, tried for vs
SCALE = base.Parameter("vs", "rad/s", lower=1e-3, upper=10.0, grid_share=0.03)


@base.late_jit
def bend(steps, s0, z, bent):
    """Fill bent (m, n): how far the bristles of n joints are bent after each step of way.

    Exact where the joint does not turn round within a step: z goes to the direction s as
    s + (z - s) exp(-|step| / s0).

    Args:
        steps: (m, n) rad, from the instant before; s0: (n,) rad.
        z: (n,) before the first step; holds afterwards what it is after the last.
    """
    for i in range(steps.shape[0]):
        for j in range(steps.shape[1]):
            way = np.sign(steps[i, j])
            z[j] = way + (z[j] - way) * np.exp(-np.abs(steps[i, j]) / s0[j])
            bent[i, j] = z[j]


def bending(q: Array, s0: float) -> Array:
    """z (m,) of bristles along the way of a joint q (m,), rad, that starts at zero."""
    steps = np.diff(q, prepend=q[:1])
    z = np.empty((len(q), 1))
    bend(steps[:, None], np.array([s0]), np.zeros(1), z)
    return z[:, 0]


class Rubs(base.JointTorque):
    """Friction that may wind up over a small way s0 before the joint slides."""

    @abstractmethod
    def level(self, dq: Array, values: Values) -> Array:
        """N m of a joint that slides at dq, rad/s."""

    def bristles(self, values: Values) -> float | None:
        """s0, where it has one."""
        return float(values["s0"]) if "s0" in values else None

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """The level in motion, as dry friction; at rest where the format knows both."""
        part = "Fc is there as the joint's friction"
        rest = float(values.get("Fs", values["Fc"])) - float(values["Fc"])
        if rest and more.at_joint(BREAKAWAY, joint, rest) is None:
            part = "Fs holds the joint, and Fc is its friction once it slides"
        return more.at_joint(FRICTION, joint, values["Fc"], part)

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """The level times z, which is zero before the motion; of rows apart as if each slid."""
        dq, s0 = motion.dq[:, joint], self.bristles(values)
        at_once = motion.apart or s0 is None
        z = motion.direction[:, joint] if at_once else bending(motion.q[:, joint], cast(float, s0))
        return base.on_joint(motion, joint, self.level(dq, values) * z)


class BristleFriction(base.LearnedEffect, Rubs):
    """Coulomb friction that winds up over a small way before the joint slides (Dahl).

    tau = Fc z, dz/dt = (dq - |dq| z) / s0. Positive Fc opposes motion. What rubs does not slide at
    once: it bends over a way of about s0 first. How far it is bent, z, is between -1 and 1, depends
    on the way alone, not on its speed, and stays where the joint rests: at rest it is the band of
    static friction. Source: P. Dahl, A Solid Friction Model, 1968.
    """

    name = "bristle_friction"
    title = "bristle friction"
    parameters = (base.Parameter("Fc", "N m"), WAY)
    prior_std = 1.0  # of Fc, as of Coulomb friction
    shape_key, shapes = "s0", WAYS_RAD
    positive = ("Fc",)
    inexact = 0.02
    band = 0.3  # static friction is 1 to 1.6 times Coulomb's in what is published
    form = base.LEVEL
    bundled = True
    simpler = ((base.LEVEL, 0.01),)  # Coulomb friction, which is the same where s0 is small
    phrase = Phrase("{who} {lacks} {Fc} of bristle friction, which winds up over {s0}", "Fc")
    shows = ((STILL, "fades or changes sign"), (TURNS, "turns over gradually"))

    def templates(self) -> tuple[base.Template, ...]:
        """The level, at several ways; at once it is Coulomb friction."""
        return tuple(map(_template, WAYS_RAD[1:]))

    def reshaped(self, values: Values, ratio: float) -> tuple[base.Template, ...]:
        """Another s0."""
        return (_template(WAY.nearest(ratio * float(values["s0"]))),)

    def log_odds_of(self, values: Values) -> float:
        """Friction that slides at once looks like bristles over a way that no joint has."""
        return log_odds_of_way(float(values["s0"]))

    def level(self, dq: Array, values: Values) -> Array:
        """Fc."""
        return np.full_like(dq, values["Fc"])

    def law(self, at: JointSignals, values: Values) -> Array:
        """Fc z."""
        return np.asarray(values["Fc"] * self.torque_per_unit(at, values["s0"]))

    def learned_as(self, value: float, shape: float) -> tuple[str, dict[str, float]]:
        """Coulomb friction where it slides at once."""
        if shape <= self.shapes[0]:
            return "coulomb_friction", {"Fc": value}
        return super().learned_as(value, shape)

    def basis(self, at: JointSignals) -> tuple[Array, ...]:
        """z of each of the ways."""
        return tuple(at.bent)

    def shares(self, shape: Array) -> Array:
        """Those of the ways around s0."""
        return shares_of_ways(shape)


def log_odds_of_way(s0: float) -> float:
    """ln of how much rarer bristles over s0 (rad) are met than those of a usual way."""
    return float(-0.5 * (np.log(s0 / USUAL_RAD) / np.log(TIMES)) ** 2)


def _template(s0: float) -> base.Template:
    return base.Template((1.0,), lambda x: {"Fc": float(x[0]), "s0": s0}, f"s0 = {s0:.3g} rad")


class StribeckFriction(Rubs):
    """Friction that falls from Fs at rest to Fc in motion, and may wind up over a way before.

    (Fc + (Fs - Fc) exp(-(dq/vs)^2)) sign(dq), or z of bristles for the sign. With bristles it is
    LuGre's friction without damping (Canudas de Wit et al., A New Model for Control of Systems with
    Friction, 1995), their stiffness being that of the level at which they slide.
    """

    name = "stribeck_friction"
    title = "Stribeck friction"
    parameters = (base.Parameter("Fc", "N m"), base.Parameter("Fs", "N m"), SCALE, MAYBE_WAY)
    positive = ("Fc", "Fs")
    log_odds = -3.0
    inexact = 0.03
    simpler = ((base.LEVEL, 0.01), (base.TWO_LEVELS, 0.01))
    phrase = Phrase("{who} {lacks} Stribeck friction of {Fs} at rest and {Fc} in motion")
    shows = ((SPEEDS, "falls as the joint gets faster"), (STILL, "fades or changes sign"))

    def templates(self) -> tuple[base.Template, ...]:
        """Both levels at several velocity scales, without bristles and with."""
        return tuple(_falling(vs, s0) for s0 in (None, USUAL_RAD) for vs in VELOCITIES)

    def reshaped(self, values: Values, ratio: float) -> tuple[base.Template, ...]:
        """Another vs, another s0."""
        vs, s0 = float(values["vs"]), self.bristles(values)
        other = _falling(SCALE.nearest(ratio * vs), s0)
        return (other,) if s0 is None else (other, _falling(vs, WAY.nearest(ratio * s0)))

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


def _falling(vs: float, s0: float | None = None) -> base.Template:
    fixed = {"vs": vs} if s0 is None else {"vs": vs, "s0": s0}
    said = f"vs = {vs:.3g} rad/s" + ("" if s0 is None else f", s0 = {s0:.3g} rad")
    return base.Template(
        (1.0, 1.0), lambda x: {"Fc": float(x[0]), "Fs": float(x[1]), **fixed}, said
    )
