"""Signal delay: the torque is late by d against the position, tau_measured(t) = tau(t - d)."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import ALL, Array, Motion, Parameter, SensorEffect, Values

MOST_S = 0.012  # a bus, a filter and a hold together are faster


class SignalDelay(SensorEffect):
    """Torque signals that arrive later than positions; of all joints or of one."""

    name = "signal_delay"
    title = "signal delay"
    scope = ALL
    parameters = (Parameter("d", "s", lower=-0.1, upper=0.1),)
    typical = 3e-3
    inexact = 0.02
    split_by = "move faster, with sharp reversals"

    def possible(self, values: Values) -> bool:
        """Late, by a dozen milliseconds at most; what asks for more is something else."""
        return 0.0 < float(values["d"]) < MOST_S

    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """tau(t - d): by its rate, which is exact enough for a few ms of smooth torque."""
        late = tau - float(values["d"]) * motion.rate(tau)
        if joint < 0:
            return late
        out = tau.copy()
        out[:, joint] = late[:, joint]
        return np.asarray(out)
