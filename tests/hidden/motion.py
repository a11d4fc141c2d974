"""Motions of a simulated arm inside its limits: sines, from point to point, guided by hand."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.signal import lfilter

from sim.truth import Array, Limits

KINDS, SHARES = ("sines", "points", "hand"), (0.5, 0.25, 0.25)
SINES = 6
BAND_HZ = (0.05, 0.9)  # of the sines
SLOW_SHARE, SLOW_FACTOR = 0.2, 0.3  # so many motions are slower, by this factor
RAMP_S = 1.0  # a motion fades in over the first second, from rest
MARGIN_RAD = 0.1  # kept from the ends of a joint's range
REACH_RAD = (0.5, 1.2)  # largest excursion of a joint from its middle
SPEED_SHARE = (0.4, 0.75)  # largest speed of a joint, of its limit
ACCELERATION_SHARE = 0.6  # of its limit
POSTURE_RAD = 0.3  # how far the middle of a motion is from the ready posture, at most
REST_S, MOVE_S = (0.2, 1.0), (0.6, 2.0)  # of motions from point to point
HAND_HZ = 0.6  # a hand guides an arm with noise below this
SPAN_S, STEP_S, KNOT_S = 21.0, 1e-3, 0.01  # that is drawn; its step; between knots of the spline


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A smooth path through points, at rest before the first and after the last.

    Attributes:
        knots: (k, n) rad, one each `KNOT_S`.
        kind: one of `KINDS`.
        slow: drawn as one of the slower motions.
    """

    knots: Array
    kind: str
    slow: bool

    @property
    def middle(self) -> Array:
        """(n,) rad, where it starts."""
        return self.knots[0]

    @cached_property
    def _spline(self) -> BSpline:
        return make_interp_spline(KNOT_S * np.arange(len(self.knots)), self.knots, k=5)

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) at times t (m,) s; at rest before t = 0."""
        inside = np.clip(t, 0.0, KNOT_S * (len(self.knots) - 1))
        q, dq, ddq = (np.asarray(self._spline(inside, nu)) for nu in range(3))
        moves = (inside == t)[:, None]
        return q, moves * dq, moves * ddq


def draw_motion(
    rng: np.random.Generator,
    limits: Limits,
    ready: Array,
    kind: str | None = None,
    pace: Array | None = None,
) -> DrawnMotion:
    """A random motion around the ready posture (n,) rad that keeps all limits.

    Args:
        rng: decides.
        limits: of the joints.
        ready: (n,) rad.
        kind: one of `KINDS`; drawn by `SHARES` where None.
        pace: (m,) s, where in the motion the arm is, each `STEP_S`; slow or not throughout where
            None.
    """
    n = len(ready)
    kind = kind or str(rng.choice(KINDS, p=SHARES))
    slow = bool(rng.random() < SLOW_SHARE) and pace is None
    middle = ready + rng.uniform(-POSTURE_RAD, POSTURE_RAD, n)
    t: Array = np.arange(0.0, SPAN_S, STEP_S) if pace is None else pace
    drawn = {"sines": _sines, "points": points, "hand": hand}[kind]
    paced = drawn(rng, SLOW_FACTOR * t if slow else t, n)
    shape = paced
    if kind != "points":  # a quintic step from 0 to 1 over the first second
        x = np.clip(t / RAMP_S, 0.0, 1.0)
        shape = (x**3 * (10 - 15 * x + 6 * x**2))[:, None] * paced
    reach, speed = rng.uniform(*REACH_RAD, n), rng.uniform(*SPEED_SHARE, n) * limits.velocity
    if slow:
        speed = SLOW_FACTOR * speed
    dq = np.gradient(shape, STEP_S, axis=0)
    ddq = np.gradient(dq, STEP_S, axis=0)
    free = np.minimum(middle - limits.lower, limits.upper - middle) - MARGIN_RAD
    shares = (
        np.minimum(reach, free) / _largest(shape),
        speed / _largest(dq),
        ACCELERATION_SHARE * limits.acceleration / _largest(ddq),
    )
    knots = middle + (shape * np.min(shares, axis=0))[:: round(KNOT_S / STEP_S)]
    return DrawnMotion(knots, kind, slow)


def _largest(x: Array) -> Array:
    """Of each column (m, n); a little where it is zero throughout."""
    return np.maximum(np.abs(x).max(axis=0), 1e-9)


def _sines(rng: np.random.Generator, t: Array, n: int) -> Array:
    """A multi-sine per joint (m, n)."""
    w = 2 * np.pi * rng.uniform(*BAND_HZ, (SINES, 1, n))
    size = rng.normal(size=(SINES, 1, n)) / np.sqrt(w)
    phase = rng.uniform(0, 2 * np.pi, (SINES, 1, n))
    return np.asarray((size * np.sin(w * t[:, None] + phase)).sum(axis=0))


def points(rng: np.random.Generator, t: Array, n: int) -> Array:
    """From point to point with rests (m, n); a joint or two alone, or all together."""
    q, at, now = np.zeros((len(t), n)), np.zeros(n), 0.0
    while now < t[-1]:
        now += rng.uniform(*REST_S)
        length, goal = rng.uniform(*MOVE_S), at.copy()
        joints = rng.permutation(n)[: rng.choice([1, 2, n])]
        goal[joints] = rng.uniform(-1, 1, len(joints))
        x = np.clip((t - now) / length, 0, 1)[:, None]
        q = np.where(x > 0, at + (goal - at) * x**3 * (10 - 15 * x + 6 * x**2), q)
        at, now = goal, now + length
    return q


def hand(rng: np.random.Generator, t: Array, n: int) -> Array:
    """Noise through four equal low-passes (m, n), each of the first order."""
    step = float(t[1] - t[0])
    keep = float(np.exp(-2 * np.pi * HAND_HZ * step))
    early = round(2 / (HAND_HZ * step))
    out: Array = rng.standard_normal((early + len(t), n))
    for _ in range(4):
        out = lfilter([1 - keep], [1, -keep], out, axis=0)
    return np.asarray(out[early:] - out[early])
