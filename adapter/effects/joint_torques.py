"""Torques of a joint by its angle or acceleration; friction by its velocity alone, and by the load.

Positive numbers of friction oppose motion.
"""

from __future__ import annotations

from copy import copy
from functools import partial
from typing import Any

import numpy as np

from adapter.effects import base
from adapter.effects.base import Array, JointSignals, Motion, Values
from adapter.effects.law import LOG_ODDS
from adapter.effects.phrases import BOTH_WAYS, LATER, LOADS, SPEEDS, STILL, TURN, TURNS, Phrase
from adapter.model.urdf_text import ARMATURE, DAMPING, FRICTION, STIFFNESS, Additions


class MotorInertia(base.LinearEffect):
    """Torque that speeds the joint's own rotor up, seen at the joint ("armature"): tau = B ddq."""

    name = "motor_inertia"
    title = "reflected motor inertia"
    parameters = (base.Parameter("B", "kg m2"),)
    prior_std = 0.1  # a link-side sensor should see none; catalogue sizes are 0.05 to 0.3
    place = ARMATURE  # which MJCF has and URDF has not
    positive = ("B",)
    phrase = Phrase.lacks("B", "reflected motor inertia")
    shows = ((SPEEDS, "is gone"), (STILL, "is gone"))
    watched = True
    bundled = True

    def column(self, at: base.JointSignals) -> base.Array:
        """ddq."""
        return at.ddq


# Harmonic drives and motors give 1, 2, 4 and the numbers of poles and rollers.
NUMBERS = tuple(range(1, 31))


class TorqueRipple(base.JointTorque):
    """A torque that repeats with the joint's angle: a sin(n q + phase), n whole, per turn."""

    name = "torque_ripple"
    title = "torque ripple"
    parameters = (
        base.Parameter("a", "N m"),
        base.Parameter("n", "per turn", lower=0.0),
        base.Parameter("phase", "rad"),
    )
    inexact = 0.01
    turns = True
    phrase = Phrase("{who} {has} a torque ripple of {a}, {n}")
    shows = ((TURN, "repeats along the turn"),)
    over_angle = True

    def templates(self) -> tuple[base.Template, ...]:
        """Sine and cosine of each number per turn."""
        return tuple(
            base.Template((0.3, 0.3), partial(self.decode, n=n), f"n = {n}") for n in NUMBERS
        )

    def decode(self, x: base.Array, n: int = 1) -> dict[str, Any]:
        """Of sine and cosine of n turns."""
        size, phase = base.polar(x)
        return {"a": size, "n": float(n), "phase": phase}

    def log_odds_over(self, values: base.Values, turned: float) -> float:
        """Less than a whole wave may be any curve over the angle, which has no name."""
        return 0.0 if values["n"] * turned > 2.0 * np.pi else LOG_ODDS

    def law(self, at: base.JointSignals, values: base.Values) -> base.Array:
        """a sin(n q + phase)."""
        return np.asarray(values["a"] * np.sin(values["n"] * at.q + values["phase"]))


# Farther from zero no joint's spring rests, unless it is at zero but for an offset so small
FARTHEST_RAD, NOTHING_NM = np.pi, 0.02


class JointSpring(base.LearnedEffect, base.JointTorque):
    """A spring between a joint's two sides, as a cable or hose that pulls: k (q - q0).

    The learner has one that rests at zero; where it rests is in the offset that it learns beside.
    """

    name = "joint_spring"
    title = "joint spring"
    parameters = (base.Parameter("k", "N m/rad"), base.Parameter("q0", "rad"))
    prior_std, coefficients = (1.0, 1.0), ("N m/rad", "N m/rad")
    place = STIFFNESS
    phrase = Phrase(
        "a spring of {x} pulls {who} towards {q0}", "k", "{who} {is} pushed away from {q0} by {x}"
    )
    shows = ((TURN, "keeps growing with the angle"),)
    watched = True
    over_angle = True

    def templates_over(self, low: float, high: float) -> tuple[base.Template, ...]:
        """Two springs that rest at the ends of what was seen: none is likelier near zero."""
        decode = partial(self.decode, low=low, high=high)
        return (base.Template(self.prior_std, decode, f"between {low:.4g} and {high:.4g}"),)

    def decode(self, x: base.Array, low: float = 0.0, high: float = 1.0) -> dict[str, Any]:
        """Of two springs that rest at two angles, rad."""
        k = float(x[0] + x[1])
        return {"k": k, "q0": float(low * x[0] + high * x[1]) / k if k else 0.0}

    def possible(self, values: base.Values) -> bool:
        """What rests at no angle that a joint has is an offset by another name."""
        k, q0 = float(values["k"]), float(values["q0"])
        return abs(q0) < FARTHEST_RAD or abs(k * q0) < NOTHING_NM

    def columns(self, at: base.JointSignals) -> tuple[base.Array, ...]:
        """q and q - 1 rad."""
        return at.q, at.q - 1.0

    def basis(self, at: base.JointSignals) -> tuple[base.Array, ...]:
        """q."""
        return (at.q,)

    def learned_from(self, values: base.Values) -> dict[str, float]:
        """k, and the offset that a spring has which rests elsewhere."""
        k = float(values["k"])
        return {self.name: k, "torque_offset": -k * float(values["q0"])}

    def law(self, at: base.JointSignals, values: base.Values) -> base.Array:
        """k (q - q0)."""
        return np.asarray(values["k"] * (at.q - values["q0"]))

    def export(self, more: Additions, joint: int, values: base.Values) -> str | None:
        """Stiffness, which MJCF has and URDF has not."""
        part = more.at_joint(self.place, joint, values["k"])
        if part is None:
            more.pull[joint] -= values["k"] * values["q0"]
        return part


class ViscousFriction(base.LinearEffect):
    """tau = Fv dq: friction torque in proportion to the joint's speed."""

    name = "viscous_friction"
    title = "viscous friction"
    parameters = (base.Parameter("Fv", "N m s/rad"),)
    prior_std = 1.0  # published Panda values are 0.03 to 0.09 (Knezevic)
    place = DAMPING
    positive = ("Fv",)
    inexact = 0.02
    phrase = Phrase.lacks("Fv", "viscous friction")
    shows = ((SPEEDS, "rises in proportion to the speed"), (STILL, "is gone"))
    sudden = True
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """dq."""
        return at.dq


class CoulombFriction(base.LinearEffect):
    """tau = Fc sign(dq), smoothed around rest: it depends on the direction of motion alone."""

    name = "coulomb_friction"
    title = "Coulomb friction"
    parameters = (base.Parameter("Fc", "N m"),)
    prior_std = 1.0  # published Panda values are 0.2 to 0.5 (Knezevic)
    place = FRICTION
    positive = ("Fc",)
    inexact = 0.02
    band = 0.3  # static friction is 1 to 1.6 times Coulomb's in what is published
    phrase = Phrase.lacks("Fc", "Coulomb friction")
    form = base.LEVEL
    shows = ((STILL, "fades or changes sign"), (TURNS, "turns over at once"))
    sudden = True
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """tanh(dq / w) with w = 0.01 rad/s, or as far as dq goes within the smoothing time."""
        return at.direction


class AsymmetricFriction(base.JointTorque):
    """Coulomb friction of a size for either direction: Fc_pos for dq > 0, Fc_neg for dq < 0."""

    name = "asymmetric_friction"
    title = "asymmetric friction"
    parameters = (base.Parameter("Fc_pos", "N m"), base.Parameter("Fc_neg", "N m"))
    prior_std = (1.0, 1.0)
    positive = ("Fc_pos", "Fc_neg")
    log_odds = -3.0  # Coulomb friction and an offset say the same in simpler words
    inexact = 0.02
    simpler = ((base.LEVEL, 10.0), (base.LEVEL_BY_LOAD, 10.0))
    phrase = Phrase("{who} {lacks} Coulomb friction of {Fc_pos} forwards and {Fc_neg} backwards")
    form = base.TWO_LEVELS
    shows = ((STILL, "fades or changes sign"), (BOTH_WAYS, "is larger one way than the other"))

    def law(self, at: JointSignals, values: Values) -> Array:
        """Fc_pos where dq > 0, -Fc_neg where dq < 0, smoothed around rest."""
        sign = at.direction
        return np.asarray(np.where(sign > 0.0, values["Fc_pos"], values["Fc_neg"]) * sign)

    def export(self, more: Additions, joint: int, values: Values) -> str | None:
        """The mean, as dry friction."""
        mean = 0.5 * (values["Fc_pos"] + values["Fc_neg"])
        return more.at_joint(FRICTION, joint, mean, "the mean of both is there as friction")


class LoadDependentFriction(base.LinearEffect):
    """Fl |tau| sign(dq): friction in proportion to the rigid torque tau that the gear carries."""

    name = "load_dependent_friction"
    title = "load-dependent friction"
    parameters = (base.Parameter("Fl", "1"),)
    prior_std = 0.05
    positive = ("Fl",)
    log_odds = -1.0
    inexact = 0.03
    phrase = Phrase(
        "{who} {lacks} friction of {x} of its load",
        "Fl",
        "{who} {has} less friction than the model says, by {x} of its load",
    )
    form = base.LEVEL_BY_LOAD
    by_load = True
    shows = ((LOADS, "grows with the load"), (STILL, "fades or changes sign"))

    def column(self, at: JointSignals) -> Array:
        """|tau| sign(dq)."""
        return np.asarray(np.abs(at.tau) * at.direction)


SLOWEST = 0.008  # N m/s
LONG_S, RISE_NM = 60.0, 0.16  # in a longer recording: what it rises by in all, as within 20 s


class FrictionDrift(base.TorqueEffect):
    """A gear that warms up: Coulomb friction changes by dFc each second, from the start on."""

    name = "friction_drift"
    title = "friction drift"
    parameters = (base.Parameter("dFc", "N m/s"),)
    prior_std = 0.05
    log_odds = -5.0
    inexact = 0.03
    phrase = Phrase(
        "the friction of {who} rises by {x}", "dFc", "the friction of {who} falls by {x}"
    )
    shows = ((STILL, "fades or changes sign"), (LATER, "has gone on"))

    slowest = SLOWEST

    def over(self, seconds: float) -> FrictionDrift:
        """Over an hour much less shows than over a minute."""
        if seconds <= LONG_S:
            return self
        slower = copy(self)
        slower.slowest = RISE_NM / seconds
        return slower

    def possible(self, values: Values) -> bool:
        """What drifts more slowly is not told from a velocity signal that is not quite right."""
        return abs(float(values["dFc"])) > self.slowest

    def torque(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """dFc t sign(dq), t since the effect began, or the recording."""
        column = motion.t * motion.direction[:, joint]
        return base.on_joint(motion, joint, float(values["dFc"]) * column)
