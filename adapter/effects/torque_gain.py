"""Torque sensor gain: measured = (1 + g) tau; g = 0.05 is 5 %."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import Array, Motion, Parameter, SensorEffect, Values
from adapter.effects.by_joint import ByJoint, JointSignals
from adapter.effects.phrases import Phrase
from adapter.effects.splits import KNOWN_WEIGHT, LOADS


class TorqueGain(SensorEffect):
    """A torque sensor that reads too much or too little in proportion."""

    name = "torque_gain"
    title = "torque sensor gain"
    parameters = (Parameter("g", "1", lower=-0.95),)
    prior_std = 0.05
    phrase = Phrase.reads("g", "torque sensor")
    shows = ((LOADS, "grows with the load"), (KNOWN_WEIGHT, "misreads it in proportion"))
    watched = True

    def columns(self, at: JointSignals) -> tuple[Array, ...]:
        """The torque itself."""
        return (at.tau,)

    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """(1 + g) tau on the joint."""
        out = tau.copy()
        out[:, joint] *= 1.0 + float(values["g"])
        return out

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The gain."""
        sums.log_gain[joint] += np.log1p(float(values["g"]))
        return True
