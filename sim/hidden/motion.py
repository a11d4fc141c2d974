"""Motions for hidden-effect trials: a random multi-sine per joint inside an arm's limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.truth import Array, Limits

SINES = 6
BAND_HZ = (0.05, 0.9)  # of the sines
SLOW_SHARE, SLOW_FACTOR = 0.2, 0.3  # so many motions are slower, by this factor
RAMP_S = 1.0  # the motion fades in over the first second, from rest
MARGIN_RAD = 0.1  # kept from the ends of a joint's range
REACH_RAD = (0.5, 1.2)  # largest excursion of a joint from its middle
SPEED_SHARE = (0.4, 0.75)  # largest speed of a joint, of its limit
ACCELERATION_SHARE = 0.6  # of its limit
POSTURE_RAD = 0.3  # how far the middle of a motion is from the ready posture, at most
CHECK_S = 21.0  # limits are checked on this much of the motion


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """q_j(t) = middle_j + envelope(t) sum_i size_ij sin(w_ij t + phase_ij).

    Attributes:
        middle: (n,) rad.
        size: (sines, n) rad; w: (sines, n) rad/s; phase: (sines, n) rad.
        slow: drawn as one of the slower motions.
    """

    middle: Array
    size: Array
    w: Array
    phase: Array
    slow: bool

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) at times t (m,) s; at rest before t = 0."""
        q = np.zeros((len(t), len(self.middle)))
        dq, ddq = q.copy(), q.copy()
        for size, w, phase in zip(self.size, self.w, self.phase, strict=True):
            angle = np.outer(t, w) + phase
            sine, cosine = np.sin(angle), np.cos(angle)
            q += size * sine
            dq += size * w * cosine
            ddq -= size * w * w * sine
        e, de, dde = (part[:, None] for part in _fade_in(t))
        return self.middle + e * q, de * q + e * dq, dde * q + 2 * de * dq + e * ddq

    def as_dict(self) -> dict[str, object]:
        """Plain numbers for a truth file."""
        numbers = {key: getattr(self, key).tolist() for key in ("middle", "size", "w", "phase")}
        return {**numbers, "slow": self.slow}


def draw_motion(rng: np.random.Generator, limits: Limits, ready: Array) -> DrawnMotion:
    """A random motion around the ready posture (n,) rad that keeps all limits."""
    n = len(ready)
    slow = bool(rng.random() < SLOW_SHARE)
    middle = ready + rng.uniform(-POSTURE_RAD, POSTURE_RAD, n)
    w = 2 * np.pi * rng.uniform(*BAND_HZ, (SINES, n))
    size = rng.normal(size=(SINES, n)) / np.sqrt(w)
    phase = rng.uniform(0, 2 * np.pi, (SINES, n))
    reach, speed = rng.uniform(*REACH_RAD, n), rng.uniform(*SPEED_SHARE, n) * limits.velocity
    if slow:
        w, speed = SLOW_FACTOR * w, SLOW_FACTOR * speed
    shape = DrawnMotion(np.zeros(n), size, w, phase, slow)
    q, dq, ddq = shape.at(np.arange(0, CHECK_S, 0.01))
    free = np.minimum(middle - limits.lower, limits.upper - middle) - MARGIN_RAD
    shares = (
        np.minimum(reach, free) / np.abs(q).max(axis=0),
        speed / np.abs(dq).max(axis=0),
        ACCELERATION_SHARE * limits.acceleration / np.abs(ddq).max(axis=0),
    )
    return DrawnMotion(middle, size * np.min(shares, axis=0), w, phase, slow)


def _fade_in(t: Array) -> tuple[Array, Array, Array]:
    """Quintic step from 0 to 1 over the first second, (m,), and its two derivatives."""
    x = np.clip(t / RAMP_S, 0.0, 1.0)
    value = x**3 * (10 - 15 * x + 6 * x**2)
    return (
        value,
        30 * x**2 * (1 - x) ** 2 / RAMP_S,
        60 * x * (1 - x) * (1 - 2 * x) / RAMP_S**2,
    )
