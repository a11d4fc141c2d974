"""What encoders and torque sensors make of the arm's true state, noise aside.

The encoder sits on the motor's side of the gear: it reads the link angle plus the gear's twist
tau/k plus the play, and has an offset and a ripple of its own. The torque sensor's chain is
crosstalk, bent curve, gain and offset, deadband, low-pass, and last the delay of its signal.
Gyroscopes and accelerometers glued on links sit there anyhow: small MEMS parts, each at its own
rate, noise included.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import cont2discrete, lfilter, lfilter_zi

from drivers.errors import choices
from drivers.interface import LinkMotion
from sim.effects import ENCODER, TORQUE, Effect
from sim.truth import Array, Truth

CROSSING_S = 0.01  # the motor crosses the gear's play in this time
_TORQUE_CHAIN = (
    *("x_torque_crosstalk", "x_torque_saturation", "torque_gain", "torque_offset"),
    "x_torque_deadband",
)
LATE_TICKS = 6  # at most: a reading's stamp comes after what it measured


class Sensor(NamedTuple):
    """One sensor glued on a link.

    Attributes:
        link: it is on, from 0.
        turn, place: (3, 3) its axes in the link's, (3,) m.
        w_bias, a_bias: (3,) rad/s, m/s².
        every, late: ticks from one reading to the next, and of its stamp.
    """

    link: int
    turn: Array
    place: Array
    w_bias: Array
    a_bias: Array
    every: int
    late: int


class Imus:
    """The sensors glued on an arm's links: told of every tick in order.

    Args:
        names: of the arm's links.
        on: links with a sensor.
        seed: of how they sit, biases and noise.
        period_s: of a tick.

    Raises:
        ValueError: no such link (names the choices).
    """

    def __init__(
        self, names: tuple[str, ...], on: tuple[str, ...], seed: int, period_s: float
    ) -> None:
        for name in on:
            if name not in names:
                raise ValueError(f"no link {name!r} for a sensor; {choices(name, names)}")
        self._rng = np.random.default_rng([seed, 1 << 33])  # apart from noise and truth
        self._n, self._k = len(names), -1
        self.sensors = [self._drawn(names.index(name), period_s) for name in on]
        self._past: deque[Array] = deque(maxlen=LATE_TICKS + 1)

    def _drawn(self, link: int, period_s: float) -> Sensor:
        rng = self._rng
        axes, signs = np.linalg.qr(rng.standard_normal((3, 3)))
        turn = axes * np.sign(signs.diagonal())
        turn[:, 0] *= np.linalg.det(turn)
        every = max(round(1.0 / (rng.uniform(*(200.0, 500.0)) * period_s)), 1)
        w_bias = np.radians(0.5) * rng.uniform(-1, 1, 3)  # rad/s
        a_bias = 0.2 * rng.uniform(-1, 1, 3)  # m/s²
        place, late = 0.05 * rng.standard_normal(3), int(rng.integers(0, LATE_TICKS + 1))  # m
        return Sensor(link, turn, place, w_bias, a_bias, every, late)

    def read(self, motion: Array) -> LinkMotion:
        """What arrives at the next tick: w and a in the sensors' axes, all else not a number.

        Args:
            motion: (n, 4, 3) true v, w, a (with gravity) and dw of the links, in their frames.
        """
        self._k += 1
        self._past.appendleft(motion)
        twist, accel = np.full((2, self._n, 6), np.nan)
        for s in self.sensors:
            if (self._k + s.late) % s.every or s.late >= len(self._past):
                continue
            _, w, a, dw = self._past[s.late][s.link]
            felt = a + np.cross(dw, s.place) + np.cross(w, np.cross(w, s.place))
            noise = self._rng.standard_normal((2, 3))
            twist[s.link, 3:] = w @ s.turn + s.w_bias + 1.75e-3 * noise[0]  # rad/s rms
            accel[s.link, :3] = felt @ s.turn + s.a_bias + 0.04 * noise[1]  # m/s² rms
        return LinkMotion(twist, accel)


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
        way = np.clip(dq / 0.01, -1.0, 1.0)  # rad/s, below it the motor pushes neither way in full
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
        for name in _TORQUE_CHAIN:
            for effect in self._effects:
                if effect.name == name and effect.acts(t):
                    on, number = effect.columns(self._n), effect.number
                    if name == "x_torque_crosstalk":
                        tau[on[1]] += number("share") * true[on[0]]
                    elif name == "x_torque_saturation":
                        tau[on] = number("s") * np.tanh(tau[on] / number("s"))
                    elif name == "torque_gain":
                        tau[on] *= 1.0 + number("g")
                    elif name == "torque_offset":
                        tau[on] += number("o")
                    else:
                        tau[on] -= np.clip(tau[on], -number("w"), number("w"))
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
