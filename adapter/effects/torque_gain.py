"""Torque sensor gain: measured = (1 + g) tau; g = 0.05 is 5 %."""

from __future__ import annotations

from adapter.effects.base import Array, Motion, Parameter, SensorEffect, Values


class TorqueGain(SensorEffect):
    """A torque sensor that reads too much or too little in proportion."""

    name = "torque_gain"
    title = "torque sensor gain"
    parameters = (Parameter("g", "1", lower=-0.95),)
    typical = 0.05
    split_by = "repeat the motion with and without a known load at the flange"

    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """(1 + g) tau on the joint."""
        out = tau.copy()
        out[:, joint] *= 1.0 + float(values["g"])
        return out
