"""Torques of a joint beside friction: by its angle, or by its acceleration."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from adapter.effects import base
from adapter.effects.law import LOG_ODDS
from adapter.effects.phrases import SPEEDS, STILL, TURN, Phrase
from adapter.model.urdf_text import ARMATURE, STIFFNESS, Additions


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
