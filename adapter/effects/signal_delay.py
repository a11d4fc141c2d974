"""Signal delay: the torque is late by d against the position, tau_measured(t) = tau(t - d)."""

from __future__ import annotations

import numpy as np

from adapter.effects.base import ALL, LATE, Array, Motion, Parameter, SensorEffect, Values
from adapter.effects.by_joint import ByJoint
from adapter.effects.phrases import Phrase
from adapter.effects.splits import LOADS, SPEEDS, STILL

MOST_S = 0.012  # a bus, a filter and a hold together are faster


class SignalDelay(SensorEffect):
    """Torque signals that arrive later than positions; of all joints or of one."""

    name = "signal_delay"
    title = "signal delay"
    scope = ALL
    parameters = (Parameter("d", "s", lower=-0.1, upper=0.1),)
    prior_std = 3e-3
    inexact = 0.02
    form = LATE
    phrase = Phrase(
        "the torque of {who} comes {x} after the position",
        "d",
        "the torque of {who} comes {x} before the position",
    )
    shows = (
        (LOADS, "grows with the load"),
        (SPEEDS, "rises in proportion to the speed"),
        (STILL, "is gone"),
    )

    def possible(self, values: Values) -> bool:
        """Late, by a dozen milliseconds at most; what asks for more is something else."""
        return 0.0 < float(values["d"]) < MOST_S

    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """tau(t - d): whole samples later, and by its rate what is less."""
        d = float(values["d"])
        step = 0.0 if motion.apart else float(np.median(np.diff(motion.t)))
        whole = step * round(d / step) if step else 0.0
        before = tau
        if whole:
            before = np.column_stack([np.interp(motion.t - whole, motion.t, x) for x in tau.T])
        late = before - (d - whole) * motion.rate(before)
        if joint < 0:
            return np.asarray(late)
        out = tau.copy()
        out[:, joint] = late[:, joint]
        return np.asarray(out)

    def at_instant(self, sums: ByJoint, joint: int | slice, values: Values) -> bool:
        """The delay."""
        sums.delay_s[joint] += float(values["d"])
        return True
