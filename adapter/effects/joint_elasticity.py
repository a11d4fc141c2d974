"""Joint elasticity: the encoder sits on the motor side, q_measured = q_link + tau / k."""

from __future__ import annotations

import math
from typing import Any

from adapter.effects.base import Array, Motion, MotionEffect, Parameter, Values
from adapter.effects.by_joint import ByJoint
from adapter.effects.phrases import Phrase
from adapter.effects.splits import LOADS


class JointElasticity(MotionEffect):
    """A gear that twists under the joint's torque."""

    name = "joint_elasticity"
    title = "joint elasticity"
    parameters = (Parameter("k", "N m/rad"),)
    prior_std = 2e-4  # rad/(N m), of 1/k: a typical harmonic drive has 5000 N m/rad
    positive = ("k",)
    inexact = 0.05
    phrase = Phrase("{who} {is} elastic, with a stiffness of {k}")
    shows = ((LOADS, "grows with the square of the load"),)

    def decode(self, x: Array) -> dict[str, Any]:
        """Of 1/k, which is zero where the gear is rigid."""
        return {"k": 1.0 / float(x[0]) if x[0] else math.inf}

    def link_side(self, motion: Motion, tau: Array, joint: int, values: Values) -> Motion:
        """q - tau/k with two derivatives: fourth ones of q, nothing but noise above a band."""
        twist = -motion.inside_band(tau[:, joint], joint) / float(values["k"])
        speed = motion.rate(twist)
        return motion.moved(joint, twist, speed, motion.rate(speed))

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The compliance."""
        sums.compliance[joint] += 1.0 / float(values["k"])
        return True
