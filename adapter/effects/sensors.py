"""What torque sensors make of a torque."""

from __future__ import annotations

import numpy as np

from adapter.effects import base as base
from adapter.effects.base import Array, Motion, Values
from adapter.effects.by_joint import JointSignals
from adapter.effects.phrases import KNOWN_WEIGHT, LOADS, SPEEDS, STILL, SWINGS, Phrase

LATEST_S = 0.012  # a bus, a filter and a hold together are faster

# Of a low-pass
MOST_AHEAD_S, MOST_S = 3e-3, 0.06  # velocities that come late make torque look early
AFTERWARDS = -40.0  # ln of the odds that only the torques of a log were filtered without phase
SLOW_S = 0.02  # of sensors whose low-pass is there to be seen: 5 to 20 Hz
LEAST_C_S2 = 5e-5  # that noise of the motion does not look like


class TorqueOffset(base.LinearEffect):
    """A constant that the joint's torque sensor adds: tau_measured = tau + o."""

    name = "torque_offset"
    title = "torque sensor offset"
    parameters = (base.Parameter("o", "N m"),)
    prior_std = 1.0
    phrase = Phrase.reads("o", "torque sensor")
    after_sensors = True  # whatever else the sensors do
    sudden = True
    watched = True
    bundled = True

    def column(self, at: JointSignals) -> Array:
        """One."""
        return np.ones_like(at.dq)


class TorqueGain(base.SensorEffect):
    """A torque sensor that reads too much or too little in proportion.

    measured = (1 + g) tau; g = 0.05 is 5 %.
    """

    name = "torque_gain"
    title = "torque sensor gain"
    parameters = (base.Parameter("g", "1", lower=-0.95),)
    prior_std = 0.05
    phrase = Phrase.reads("g", "torque sensor")
    instant = "log_gain", lambda values: np.log1p(values["g"])
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


LATENESS = (
    (LOADS, "grows with the load"),
    (SPEEDS, "rises in proportion to the speed"),
    (STILL, "is gone"),
)


class SignalDelay(base.SensorEffect):
    """Torque signals that arrive later than positions; of all joints or of one.

    tau_measured(t) = tau(t - d).
    """

    name = "signal_delay"
    title = "signal delay"
    scope = base.ALL
    parameters = (base.Parameter("d", "s", lower=-0.1, upper=0.1),)
    prior_std = 3e-3
    inexact = 0.02
    form = base.LATE
    instant = "delay_s", lambda values: values["d"]
    phrase = Phrase(
        "the torque of {who} comes {x} after the position",
        "d",
        "the torque of {who} comes {x} before the position",
    )
    shows = LATENESS

    def possible(self, values: Values) -> bool:
        """Late, by a dozen milliseconds at most; what asks for more is something else."""
        return 0.0 < float(values["d"]) < LATEST_S

    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """tau(t - d): whole samples later, and by its rate what is less."""
        d = float(values["d"])
        step = 0.0 if motion.apart else float(np.median(np.diff(motion.t)))
        whole = step * round(d / step) if step else 0.0
        before = tau
        if whole:
            before = np.column_stack([np.interp(motion.t - whole, motion.t, x) for x in tau.T])
        late = before - (d - whole) * motion.rate(before)
        out, own = tau.copy(), slice(None) if joint < 0 else joint
        out[:, own] = late[:, own]
        return np.asarray(out)


class TorqueFilter(base.LearnedEffect, base.SensorEffect):
    """A torque sensor that passes only what is slow; all joints' alike, or one's.

    (d² - c) measured'' + d measured' + measured = tau. Its series begins with
    tau - d dtau/dt + c d2tau/dt2, that of any low-pass does: d is its mean delay, 2 c the mean
    square of its delays. A pure delay has c = d^2 / 2, one pole c = d^2, and no sensor has more;
    one without phase, by which a log was filtered afterwards, has d = 0.
    """

    name = "torque_filter"
    title = "torque sensor low-pass"
    scope = base.ALL
    parameters = (base.Parameter("d", "s", lower=-0.1, upper=0.1), base.Parameter("c", "s2"))
    prior_std = (3e-3, 1e-4)
    rate = 1
    learned, step = 1, 1e-4  # c; how late a torque is, is for `gap` to say
    positive = ("c",)
    log_odds = -8.0
    inexact = 0.02
    simpler = ((base.LATE, 0.03),)
    form = base.LATE
    phrase = Phrase("the torque sensor of {who} is a low-pass, with d = {d} and c = {c}")
    shows = (*LATENESS, (SWINGS, "makes the torque smaller"))

    def templates(self) -> tuple[base.Template, ...]:
        """Of a motor's or a sensor's electronics; and a slow one of one time constant."""

        slow = base.Template(
            (SLOW_S,),
            lambda x: {"d": float(x[0]), "c": float(x[0]) ** 2},
            "of first order",
            chord=True,
        )
        return (*super().templates(), slow)

    def possible(self, values: Values) -> bool:
        """Smoother, and not much earlier."""
        return -MOST_AHEAD_S < float(values["d"]) < MOST_S and super().possible(values)

    def log_odds_of(self, values: Values) -> float:
        """Smoother than any sensor that is no later makes it, noise of the motion looks like it."""
        most = max(float(values["d"]) + MOST_AHEAD_S, 0.0) ** 2 + LEAST_C_S2
        return AFTERWARDS if float(values["c"]) > most else 0.0

    def low_pass(self, values: Values) -> tuple[float, float]:
        """The one whose series begins so; where there is none (see `measured`), the nearest."""
        d = max(float(values["d"]), 0.0)
        return d, min(max(d * d - float(values["c"]), 0.0), d * d)

    def measured(self, motion: Motion, tau: Array, joint: int, values: Values) -> Array:
        """The low-pass of tau, on the joint or all of them; by the series what none of them is.

        Fourth derivatives of q are nothing but noise above a band; noise in there would make any
        measured torque look smoother than the one that the motion asks for.
        """
        d, b = self.low_pass(values)
        early, more = min(float(values["d"]), 0.0), float(values["c"]) - (d * d - b)
        out = tau.copy()
        for j in range(tau.shape[1]) if joint < 0 else (joint,):
            own = tau[:, j]
            bend = motion.rate(motion.rate(motion.inside_band(own, j)))
            out[:, j] = motion.lagged(own, d, b) + more * bend - early * motion.rate(own)
        return np.asarray(out)

    def basis(self, at: JointSignals) -> tuple[Array, ...]:
        """The second rate of the model's torque."""
        return (at.rates[self.rate],)
