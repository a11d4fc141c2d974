"""A motion along a path: softly on, softly off, and within the limits wherever it stops.

A path q(s) has a path time s whose rate ds/dt = r goes from 0 to 1 at the start and back to 0 at a
stop (quintic steps), so

    dq = r q'(s),   ddq = r² q''(s) + r' q'(s),   and r <= 1.

Where it starts slowly, r goes to `slow_share` first and from there to 1 after `slow_s` seconds. r
is a product of steps of which at most two move at a time, which bounds r' and r''; with a slow
start it is r = slow_share r1 + (1 - slow_share) r2 of two such products.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.errors import SettingsError
from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from drivers.errors import choices

UNKNOWN_RANGE = 0.5  # rad to each side, of a joint whose range nobody documented


@jit
def smooth_step(x):
    """Quintic step (value, slope) at x: 0 up to 0, 1 from 1 on."""
    if x <= 0.0:
        return 0.0, 0.0
    if x >= 1.0:
        return 1.0, 0.0
    return x * x * x * (10.0 + x * (6.0 * x - 15.0)), 30.0 * x * x * (1.0 - x) * (1.0 - x)


@jit
def sums_of_sines(s, centre, amplitude, omega, phase, out):
    """q, q', q'' (3, n) of the path at path time s."""
    for j in range(centre.shape[0]):
        q, v, a = centre[j], 0.0, 0.0
        for i in range(omega.shape[1]):
            w = omega[j, i]
            angle = w * s + phase[j, i]
            x = amplitude[j, i] * math.sin(angle)
            q += x
            v += amplitude[j, i] * w * math.cos(angle)
            a -= w * w * x
        out[0, j], out[1, j], out[2, j] = q, v, a


class PathMotion(ABC):
    """A motion that starts at rest at q0, the path at path time 0.

    Args:
        q0: (n,) where the arm is, rad.
        settings: of the start, the stop and the rests.

    Attributes:
        q, dq, ddq: (n,) reference of the last `advance`.
    """

    def __init__(self, q0: Array, settings: ExcitationSettings) -> None:
        self.settings = settings
        self._s = self._t = 0.0
        self._rate = 0.0
        self._stop_at: float | None = None
        self.q, self.dq, self.ddq = q0, np.zeros(len(q0)), np.zeros(len(q0))

    @abstractmethod
    def path(self, s: float) -> Array:
        """q, q', q'' (3, n) at path time s; the next call may overwrite them."""

    @abstractmethod
    def bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """What is never left: lowest and highest q, highest |dq|, |ddq| and |jerk|, (n,) each."""

    def advance(self, dt_s: float) -> None:
        """Go on by dt_s seconds; the reference is in `q`, `dq`, `ddq`."""
        self._t += dt_s
        rate, slope = self._rate_at(self._t)
        self._s += 0.5 * (self._rate + rate) * dt_s
        self._rate = rate
        position, velocity, acceleration = self.path(self._s)
        self.q = position.copy()
        self.dq = rate * velocity
        self.ddq = rate * rate * acceleration + slope * velocity

    def begin_stop(self) -> None:
        """Come to rest within `stop_s` from now on, along the path."""
        if self._stop_at is None:
            self._stop_at = self._t

    @property
    def time_s(self) -> float:
        """Motion time, s."""
        return self._t

    @property
    def at_rest(self) -> bool:
        """A stop was asked for and is done."""
        return self._stop_at is not None and self._t >= self._stop_at + self.settings.stop_s

    def _rate_at(self, t: float) -> tuple[float, float]:
        """Rate of the path time and its slope: a product of steps up and down."""
        s = self.settings
        rate, slope = smooth_step(t / s.start_s)
        slope /= s.start_s
        if s.slow_s:
            up, up_slope = smooth_step((t - s.slow_s) / s.start_s)
            part = s.slow_share + (1.0 - s.slow_share) * up
            part_slope = (1.0 - s.slow_share) * up_slope / s.start_s
            rate, slope = rate * part, slope * part + rate * part_slope
        for begin, end in s.rests:
            down, down_slope = smooth_step((t - begin) / s.stop_s)
            up, up_slope = smooth_step((t - end) / s.start_s)
            part, part_slope = 1.0 - down + up, up_slope / s.start_s - down_slope / s.stop_s
            rate, slope = rate * part, slope * part + rate * part_slope
        if self._stop_at is not None:
            down, down_slope = smooth_step((t - self._stop_at) / s.stop_s)
            slope = slope * (1.0 - down) - rate * down_slope / s.stop_s
            rate *= 1.0 - down
        return rate, slope


class SineMotion(PathMotion):
    """One whose joints follow q(s) = centre + sum_i a_i sin(w_i s + phi_i).

    Attributes:
        centre: (n,) rad; amplitude: (n, k) rad; omega: (n, k) rad/s; phase: (n, k) rad.
    """

    centre: Array
    amplitude: Array
    omega: Array
    phase: Array

    def __init__(self, q0: Array, settings: ExcitationSettings) -> None:
        super().__init__(q0, settings)
        self._path = np.zeros((3, len(q0)))

    def path(self, s: float) -> Array:
        """See the base class."""
        sums_of_sines(s, self.centre, self.amplitude, self.omega, self.phase, self._path)
        return self._path


def usable_range(
    limits: MotionLimits, q0: Array, settings: ExcitationSettings
) -> tuple[Array, Array]:
    """Range (n,), (n,) the motion may use; q0 lies in it."""
    lower = np.where(np.isfinite(limits.lower), limits.lower, q0 - UNKNOWN_RANGE)
    upper = np.where(np.isfinite(limits.upper), limits.upper, q0 + UNKNOWN_RANGE)
    outside = (q0 < lower) | (q0 > upper)
    if outside.any():
        j = int(np.argmax(outside))
        raise SettingsError(
            f"joint {j + 1} stands at {q0[j]:.3f} rad, outside its range [{lower[j]:.3f}, "
            f"{upper[j]:.3f}]; move it by hand before the start"
        )
    return np.minimum(lower + settings.margin, q0), np.maximum(upper - settings.margin, q0)


def moving(limits: MotionLimits, settings: ExcitationSettings) -> Array:
    """1 for each joint (n,) that is to move, 0 for the others."""
    names = limits.joint_names
    for name in settings.move:
        if name not in names:
            raise SettingsError(f"no joint '{name}' to move; {choices(name, names)}")
    wanted = settings.move or names
    return np.array([name in wanted for name in names]) if names else np.ones(len(limits.effort))


def ramped(
    speed: Array, acceleration: Array, jerk: Array, settings: ExcitationSettings
) -> tuple[Array, Array, Array]:
    """Bounds of a motion on a path with these bounds, while its rate changes in T seconds, too.

    |ddq| <= A + V c1 / T and |jerk| <= J + 3 A c1 / T + V c2 / T², where V, A, J are the path's
    and c1, c2 those of the ramps.
    """
    ramp = min(settings.start_s, settings.stop_s)
    # Largest slope and second derivative of the quintic step over one second, and of the product
    # of two that overlap (a stop during the stop before a rest).
    c1, c2 = 2.4 / ramp, 12.4 / ramp**2
    return speed, acceleration + c1 * speed, jerk + 3.0 * c1 * acceleration + c2 * speed


@lru_cache
def ramp_pairs(settings: ExcitationSettings) -> Array:
    """(p, 2) what acceleration along the path and speed contribute while the rate r changes.

    |ddq| <= r² |q''| + |r'| |q'|: r and r' are not largest together. Of all that two steps at a
    time lead to, both upwards being the worst, the corners that can decide.
    """
    ramp = min(settings.start_s, settings.stop_s)
    steps = np.array([smooth_step(x) for x in np.linspace(0.0, 1.0, 41)])
    value, slope = steps.T
    found = [(1.0, 0.0)]
    for slow in {0.0, settings.slow_share if settings.slow_s else 0.0}:
        first = slow + (1.0 - slow) * value
        rate = np.outer(first, value)
        bend = np.outer((1.0 - slow) * slope, value) + np.outer(first, slope)
        found += zip((rate**2).ravel(), (bend / ramp).ravel(), strict=True)
    pairs = np.array(found)
    return np.asarray(pairs[ConvexHull(pairs).vertices])


def largest(factor: Array, allowed: Callable[[Array], Array]) -> Array:
    """The factors (n,), each shrunk as far as what is `allowed` (n,) of small ones demands."""
    low, high = np.where(allowed(factor), factor, 0.0), factor
    for _ in range(50):
        middle = 0.5 * (low + high)
        good = allowed(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return low
