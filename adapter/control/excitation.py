"""Smooth random motion that shows an arm its body: inside all limits, never repeating.

Each joint follows q(s) = centre + sum_i a_i sin(w_i s + phi_i) along a path time s whose rate
ds/dt = r goes from 0 to 1 at the start and back to 0 at a stop (quintic steps), so

    dq = r q'(s),   ddq = r² q''(s) + r' q'(s),   and r <= 1.

Where it starts slowly, r goes to `slow_share` first and from there to 1 after `slow_s` seconds.
The limits hold for all time because they hold for the sums of |a_i| w_i^k, and r, a product of
steps of which at most two move at a time, keeps the bounds on r' and r'' below: with a slow start
it is r = slow_share r1 + (1 - slow_share) r2 of two such products.

`plan_lines` says what an arm is about to do, for the person beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.errors import SettingsError
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

UNKNOWN_RANGE = 0.5  # rad to each side, of a joint whose range nobody documented

# Largest slope and second derivative of the quintic step over one second, and of the product of
# two that overlap (a stop during the stop before a rest).
RAMP_SLOPE, RAMP_BEND = 2.4, 12.4
HOW_TO_STOP = (
    "To stop: Ctrl-C (or SIGTERM, or close this terminal); a second Ctrl-C stops at once. Keep a "
    "hand on the emergency stop: it is the only one that needs no software."
)


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


class RandomMotion:
    """A random motion that starts at rest at q0.

    Args:
        limits: to keep.
        q0: (n,) where the arm is, rad.
        settings: of the motion.
        attempt: another one gives another motion of the same seed.
        size: share of the amplitudes that the limits and the settings allow.

    Attributes:
        q, dq, ddq: (n,) reference of the last `advance`.

    Raises:
        SettingsError: the arm stands outside its position limits, or a joint asked for is not
            there.
    """

    def __init__(
        self,
        limits: MotionLimits,
        q0: Array,
        settings: ExcitationSettings | None = None,
        attempt: int = 0,
        size: float = 1.0,
    ) -> None:
        self.settings = s = settings or ExcitationSettings()
        q0 = np.array(q0, dtype=np.float64)
        rng = np.random.default_rng([s.seed, attempt] if attempt else s.seed)
        lower, upper = _usable_range(limits, q0, s)
        edges = np.geomspace(s.low_hz, s.high_hz, s.sines + 1)
        shape = (len(q0), s.sines)
        low, high = np.log(edges[:-1]), np.log(edges[1:])
        self.omega = 2.0 * np.pi * np.exp(low + (high - low) * rng.random(shape))
        relative = (0.5 + rng.random(shape)) / self.omega  # alike in speed, not in position
        factor = size * _scale(relative, self.omega, limits, lower, upper, s)
        factor = factor * _moving(limits, s)
        speed, reach = (relative * self.omega).sum(axis=1), relative.sum(axis=1)

        def centre(factor: Array) -> Array:
            return np.minimum(np.maximum(q0, lower + factor * reach), upper - factor * reach)

        def slow_enough(factor: Array) -> Array:
            middle, half = centre(factor), factor * reach
            return factor * speed <= s.share * limits.speed_between(middle - half, middle + half)

        factor = _largest(factor, slow_enough)
        self.amplitude, self.centre = relative * factor[:, None], centre(factor)
        phase = rng.uniform(-np.pi, np.pi, shape)
        self.phase = _phases_through(phase, self.amplitude, q0 - self.centre)
        self._path = np.zeros((3, len(q0)))
        self._s = self._t = 0.0
        self._rate = 0.0
        self._stop_at: float | None = None
        self.q, self.dq, self.ddq = q0, np.zeros(len(q0)), np.zeros(len(q0))

    def advance(self, dt_s: float) -> None:
        """Go on by dt_s seconds; the reference is in `q`, `dq`, `ddq`."""
        self._t += dt_s
        rate, slope = self._rate_at(self._t)
        self._s += 0.5 * (self._rate + rate) * dt_s
        self._rate = rate
        sums_of_sines(self._s, self.centre, self.amplitude, self.omega, self.phase, self._path)
        position, velocity, acceleration = self._path
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

    def bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """What is never left: lowest and highest q, highest |dq|, |ddq| and |jerk|, (n,) each."""
        reach, speed, acceleration, jerk = (
            (self.amplitude * self.omega**k).sum(axis=1) for k in range(4)
        )
        c1, c2 = _ramp_factors(self.settings)
        return (
            self.centre - reach,
            self.centre + reach,
            speed,
            acceleration + c1 * speed,
            jerk + 3.0 * c1 * acceleration + c2 * speed,
        )

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


def _usable_range(
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


def _moving(limits: MotionLimits, settings: ExcitationSettings) -> Array:
    """1 for each joint (n,) that is to move, 0 for the others."""
    names = limits.joint_names
    for name in settings.move:
        if name not in names:
            raise SettingsError(f"no joint '{name}' to move; have: {', '.join(names)}")
    wanted = settings.move or names
    return np.array([name in wanted for name in names]) if names else np.ones(len(limits.effort))


def _ramp_factors(settings: ExcitationSettings) -> tuple[float, float]:
    """Bounds on the slope, 1/s, and on the second derivative, 1/s², of the path's rate."""
    ramp = min(settings.start_s, settings.stop_s)
    return RAMP_SLOPE / ramp, RAMP_BEND / ramp**2


def _scale(
    relative: Array,
    omega: Array,
    limits: MotionLimits,
    lower: Array,
    upper: Array,
    settings: ExcitationSettings,
) -> Array:
    """Factor (n,) on the amplitudes with which every limit holds for all time.

    With ramps of T seconds |ddq| <= A + V c1 / T and |jerk| <= J + 3 A c1 / T + V c2 / T², where
    V, A, J are the sums of |a_i| w_i^k and c1, c2 those of the ramps.
    """
    c1, c2 = _ramp_factors(settings)
    reach, speed, acceleration, jerk = ((relative * omega**k).sum(axis=1) for k in range(4))
    room = settings.range_share * 0.5 * (upper - lower)
    wanted = settings.share * np.array(
        [
            limits.velocity / speed,
            limits.acceleration / (acceleration + c1 * speed),
            limits.jerk / (jerk + 3.0 * c1 * acceleration + c2 * speed),
        ]
    )
    factor: Array = np.minimum(room / reach, wanted.min(axis=0))
    return factor


def _largest(factor: Array, allowed: Callable[[Array], Array]) -> Array:
    """The factors (n,), each shrunk as far as what is `allowed` (n,) of small ones demands."""
    low, high = np.where(allowed(factor), factor, 0.0), factor
    for _ in range(50):
        middle = 0.5 * (low + high)
        good = allowed(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    return low


def _phases_through(phase: Array, amplitude: Array, start: Array) -> Array:
    """Phases as near to the given ones as makes sum_i a_i sin(phi_i) = start (n,).

    All phases turn towards +-pi/2, where the sum is +-sum a_i, until it is right: it changes
    continuously on the way, and |start| is not larger than that.
    """
    goal = np.where(start[:, None] >= (amplitude * np.sin(phase)).sum(axis=1)[:, None], 1.0, -1.0)
    goal = goal * np.pi / 2
    turn = np.mod(goal - phase + np.pi, 2.0 * np.pi) - np.pi
    low, high = np.zeros(len(start)), np.ones(len(start))
    rising = goal[:, 0] > 0
    for _ in range(60):
        middle = 0.5 * (low + high)
        value = (amplitude * np.sin(phase + middle[:, None] * turn)).sum(axis=1)
        short = np.where(rising, value < start, value > start)
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    found: Array = phase + high[:, None] * turn
    return found


def plan_lines(
    motion: RandomMotion,
    limits: MotionLimits,
    joint_names: Sequence[str],
    duration_s: float | None = None,
) -> list[str]:
    """How far and how fast each joint will move, against its limits, and how to stop it.

    Args:
        motion: drawn already, from where the arm is.
        limits: that it keeps.
        joint_names: (n,) in the order of the motion.
        duration_s: until the safe stop begins; None where somebody has to stop it.
    """
    settings = motion.settings
    lower, upper, speed, acceleration, jerk = motion.bounds()
    fastest = limits.speed_between(lower, upper)
    width = max(len(name) for name in joint_names)
    moving = int(np.count_nonzero(speed))
    lines = [f"This moves {moving} joints, {_until(duration_s, settings.stop_s)}."]
    if settings.slow_s:
        lines.append(
            f"The first {settings.slow_s:g} s go at {settings.slow_share:.0%} of the speed, "
            f"then within {settings.start_s:g} s to all of it."
        )
    for j, name in enumerate(joint_names):
        lines.append(
            f"{name:{width}}  {lower[j]:+.3f} .. {upper[j]:+.3f} rad "
            f"({math.degrees(lower[j]):+.1f} .. {math.degrees(upper[j]):+.1f} deg; "
            f"{_range_of(limits.lower[j], limits.upper[j], lower[j], upper[j])}), "
            f"{_speeds(speed[j], settings.slow_s, settings.slow_share)} rad/s "
            f"({_share(speed[j], fastest[j])} of {fastest[j]:.4g})"
        )
    lines.append(
        f"At most {_worst(acceleration, limits.acceleration)} of the documented acceleration and "
        f"{_worst(jerk, limits.jerk)} of the jerk of any joint."
    )
    return [*lines, HOW_TO_STOP]


def _until(duration_s: float | None, stop_s: float) -> str:
    if duration_s is None:
        return f"until somebody stops it (it comes to rest within {stop_s:g} s)"
    return f"for {duration_s:g} s and {stop_s:g} s of coming to rest"


def _range_of(low: float, high: float, lower: float, upper: float) -> str:
    if not (np.isfinite(low) and np.isfinite(high)):
        return "its limits are not documented"
    return f"limits {low:+.3f} .. {high:+.3f}, margin {min(lower - low, high - upper):.3f} rad"


def _speeds(speed: float, slow_s: float, slow_share: float) -> str:
    return (
        f"at first {slow_share * speed:.3f}, then {speed:.3f}" if slow_s else f"up to {speed:.3f}"
    )


def _share(value: float, limit: float) -> str:
    return f"{value / limit:.0%}"


def _worst(values: Array, limits: Array) -> str:
    return f"{np.max(values / limits):.0%}"
