"""Gyroscopes and accelerometers glued on links, anyhow: small MEMS parts, each at its own rate."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from drivers.errors import choices
from drivers.interface import LinkMotion
from sim.truth import Array

RATES_HZ = (200.0, 500.0)  # readings a second, between these
W_NOISE, A_NOISE = 1.75e-3, 0.04  # of a reading, rad/s and m/s² rms
W_BIAS, A_BIAS = np.radians(0.5), 0.2  # at most, rad/s and m/s²
PLACE_M = 0.05  # from the link's frame, rms by axis
LATE_TICKS = 6  # at most: a reading's stamp comes after what it measured
STREAM = 1 << 33  # keeps their draw apart from that of noise and truth


class Sensor(NamedTuple):
    """One sensor.

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
    """The sensors of an arm: told of every tick in order.

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
        self._rng = np.random.default_rng([seed, STREAM])
        self._n, self._k = len(names), -1
        self.sensors = [self._drawn(names.index(name), period_s) for name in on]
        self._past: deque[Array] = deque(maxlen=LATE_TICKS + 1)

    def _drawn(self, link: int, period_s: float) -> Sensor:
        rng = self._rng
        axes, signs = np.linalg.qr(rng.standard_normal((3, 3)))
        turn = axes * np.sign(signs.diagonal())
        turn[:, 0] *= np.linalg.det(turn)
        every = max(round(1.0 / (rng.uniform(*RATES_HZ) * period_s)), 1)
        w_bias, a_bias = W_BIAS * rng.uniform(-1, 1, 3), A_BIAS * rng.uniform(-1, 1, 3)
        place, late = PLACE_M * rng.standard_normal(3), int(rng.integers(0, LATE_TICKS + 1))
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
            twist[s.link, 3:] = w @ s.turn + s.w_bias + W_NOISE * noise[0]
            accel[s.link, :3] = felt @ s.turn + s.a_bias + A_NOISE * noise[1]
        return LinkMotion(twist, accel)
