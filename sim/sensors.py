"""What encoders and torque sensors make of the arm's true state, noise aside.

The encoder sits on the motor's side of the gear: it reads the link angle plus the gear's twist
tau/k plus the play, and has an offset and a ripple of its own. The torque sensor's chain is
crosstalk, bent curve, gain and offset, deadband, low-pass, and last the delay of its signal.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from sim.effects import ENCODER, TORQUE, Array, Effect
from sim.truth import Truth

CROSSING_S = 0.01  # the motor crosses the gear's play in this time
DIRECTION_WIDTH = 0.01  # rad/s, below it the motor pushes neither way in full


def encoded(
    effects: Sequence[Effect], t: float, q: Array, dq: Array, twisting: tuple[Array, Array]
) -> tuple[Array, Array]:
    """What the encoders read.

    Args:
        effects: any; those of encoders count, play aside.
        t: s.
        q: (n,) link angle plus play, rad.
        dq: (n,) its velocity, rad/s.
        twisting: joint torque and its rate, (n,) each, N m and N m/s.

    Returns:
        Measured q and dq.
    """
    told_q, told_dq = q.copy(), dq.copy()
    acting = [effect for effect in effects if effect.acts(t)]
    for effect in acting:
        if effect.name == "joint_elasticity":
            columns = effect.columns(len(q))
            told_q[columns] += twisting[0][columns] / effect.number("k")
            told_dq[columns] += twisting[1][columns] / effect.number("k")
    twisted_q, twisted_dq = told_q.copy(), told_dq.copy()
    for effect in acting:
        columns, size = effect.columns(len(q)), effect.number("a")
        if effect.name == "encoder_offset":
            told_q[columns] += effect.number("o")
        elif effect.name == "encoder_ripple":
            angle = twisted_q[columns] + effect.number("phase")
            told_q[columns] += size * np.sin(angle)
            told_dq[columns] += size * np.cos(angle) * twisted_dq[columns]
    return told_q, told_dq


class Play:
    """The gears' play: motor angle minus link angle, within half the width on either side.

    The link lags the motor: while the joint moves forwards the motor is ahead by half the width.
    At a reversal the motor crosses the play in `CROSSING_S`; at rest the play stays as it is.
    """

    def __init__(self, effects: Sequence[Effect], n: int) -> None:
        self._terms = [(e, j) for e in effects if e.name == "backlash" for j in e.columns(n)]
        self.exists = bool(self._terms)
        self.gap, self.rate, self._n = np.zeros(n), np.zeros(n), n

    def move(self, t: float, dq: Array, period_s: float) -> None:
        """Go on by one period at the end of which it is t and the links move at dq (n,)."""
        if not self.exists:
            return
        width = np.zeros(self._n)
        for effect, j in self._terms:
            width[j] += effect.number("b") * float(effect.acts(t))
        way = np.clip(dq / DIRECTION_WIDTH, -1.0, 1.0)
        moved = np.clip(self.gap + way * width * period_s / CROSSING_S, -width / 2, width / 2)
        self.rate, self.gap = (moved - self.gap) / period_s, moved


class LowPass:
    """A `torque_filter` as it runs; what it is given is taken as straight between ticks.

    Raises:
        ValueError: c is above d^2, which no low-pass has.
    """

    def __init__(self, effect: Effect, period_s: float) -> None:
        d, c = effect.number("d"), effect.number("c")
        if c > d * d:
            raise ValueError(f"torque_filter: c is {c}; needs no more than d^2, {d * d}")
        poles = np.trim_zeros(np.array([d * d - c, d, 1.0]), "f")
        b, self._a, _ = cont2discrete((np.ones(1), poles), period_s, "foh")
        self._b = b[0]
        self._state: Array | None = None

    def __call__(self, tau: Array) -> Array:
        """Torques (k,) of one tick more, slow; it has always been the first one before."""
        if self._state is None:
            self._state = lfilter_zi(self._b, self._a)[:, None] * tau
        out, self._state = lfilter(self._b, self._a, tau[None], axis=0, zi=self._state)
        return np.asarray(out[0])


class Sensors:
    """The sensors of a running arm: told of every tick in order."""

    def __init__(self, truth: Truth, period_s: float) -> None:
        self._effects = [e for e in truth.effects if e.place in (ENCODER, TORQUE)]
        self._n, self._period_s = truth.n, period_s
        self._play = Play(self._effects, truth.n)
        self._tau: Array | None = None
        slow = [e for e in self._effects if e.name == "torque_filter"]
        self._slow = [(e, LowPass(e, period_s)) for e in slow]
        self._late = [e for e in self._effects if e.name == "signal_delay"]
        longest = max((e.number("d") for e in self._late), default=0.0)
        self._keep = int(np.ceil(len(self._late) * longest / period_s)) + 2
        self._past: list[Array] = []

    def read(self, t: float, q: Array, dq: Array, tau: Array) -> tuple[Array, Array, Array]:
        """Measured q, dq, tau (n,) at t (s) for the links' q, dq and the driving torque."""
        last = tau if self._tau is None else self._tau
        rate = (tau - last) / self._period_s
        self._tau = tau
        self._play.move(t, dq, self._period_s)
        q, dq = q + self._play.gap, dq + self._play.rate
        told_q, told_dq = encoded(self._effects, t, q, dq, (tau, rate))
        return told_q, told_dq, self._delayed(t, self._torque(t, tau))

    def _torque(self, t: float, true: Array) -> Array:
        """What the torque sensors say of (n,), but for their delay."""
        tau = true.copy()
        for name, change in _TORQUE_CHAIN.items():
            for effect in self._effects:
                if effect.name == name and effect.acts(t):
                    columns = effect.columns(self._n)
                    change(effect, columns, true, tau)
        for effect, low_pass in self._slow:
            if effect.acts(t):
                columns = effect.columns(self._n)
                tau[columns] = low_pass(tau[columns])
        return tau

    def _delayed(self, t: float, tau: Array) -> Array:
        """tau(t - d), linear between samples; the first value for what lies before the start."""
        if not self._late:
            return tau
        self._past.insert(0, tau)
        del self._past[self._keep :]
        d = np.zeros(self._n)
        for effect in self._late:
            d[effect.columns(self._n)] += effect.number("d") * float(effect.acts(t))
        steps = np.minimum(d / self._period_s, len(self._past) - 1)
        whole = steps.astype(int)
        part, past, joints = steps - whole, np.array(self._past), np.arange(self._n)
        after = np.minimum(whole + 1, len(past) - 1)
        return np.asarray((1 - part) * past[whole, joints] + part * past[after, joints])


def _crosstalk(effect: Effect, columns: list[int], true: Array, tau: Array) -> None:
    tau[columns[1]] += effect.number("share") * true[columns[0]]


def _saturation(effect: Effect, columns: list[int], true: Array, tau: Array) -> None:
    tau[columns] = effect.number("s") * np.tanh(tau[columns] / effect.number("s"))


def _gain(effect: Effect, columns: list[int], true: Array, tau: Array) -> None:
    tau[columns] *= 1.0 + effect.number("g")


def _offset(effect: Effect, columns: list[int], true: Array, tau: Array) -> None:
    tau[columns] += effect.number("o")


def _deadband(effect: Effect, columns: list[int], true: Array, tau: Array) -> None:
    w = effect.number("w")
    tau[columns] -= np.clip(tau[columns], -w, w)


_TORQUE_CHAIN = {
    "x_torque_crosstalk": _crosstalk,
    "x_torque_saturation": _saturation,
    "torque_gain": _gain,
    "torque_offset": _offset,
    "x_torque_deadband": _deadband,
}
