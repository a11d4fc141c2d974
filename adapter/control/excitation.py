"""Smooth random motion that shows an arm its body: inside all limits, never repeating.

The limits hold for all time because they hold for the sums of |a_i| w_i^k.

`plan_lines` says what an arm is about to do, for the person beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adapter.control.limits import MotionLimits
from adapter.control.path_motion import (
    PathMotion,
    SineMotion,
    largest,
    moving,
    ramped,
    usable_range,
)
from adapter.control.settings import ExcitationSettings
from adapter.model.spatial import Array

HOW_TO_STOP = (
    "To stop: Ctrl-C (or SIGTERM, or close this terminal); a second Ctrl-C stops at once. Keep a "
    "hand on the emergency stop: it is the only one that needs no software."
)


class RandomMotion(SineMotion):
    """A random motion that starts at rest at q0.

    Args:
        limits: to keep.
        q0: (n,) where the arm is, rad.
        settings: of the motion.
        attempt: another one gives another motion of the same seed.
        size: share of the amplitudes that the limits and the settings allow.

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
        s = settings or ExcitationSettings()
        q0 = np.array(q0, dtype=np.float64)
        super().__init__(q0, s)
        rng = np.random.default_rng([s.seed, attempt] if attempt else s.seed)
        lower, upper = usable_range(limits, q0, s)
        edges = np.geomspace(s.low_hz, s.high_hz, s.sines + 1)
        shape = (len(q0), s.sines)
        low, high = np.log(edges[:-1]), np.log(edges[1:])
        self.omega = 2.0 * np.pi * np.exp(low + (high - low) * rng.random(shape))
        relative = (0.5 + rng.random(shape)) / self.omega  # alike in speed, not in position
        # speed, acceleration and jerk of the path are at most the sums of |a_i| w_i^k
        reach, speed, acceleration, jerk = (
            (relative * self.omega**k).sum(axis=1) for k in range(4)
        )
        allowed = np.array([limits.velocity, limits.acceleration, limits.jerk])
        wanted = s.share * (allowed / ramped(speed, acceleration, jerk, s))
        room = s.range_share * 0.5 * (upper - lower)
        factor: Array = size * np.minimum(room / reach, wanted.min(axis=0)) * moving(limits, s)

        def centre(factor: Array) -> Array:
            return np.minimum(np.maximum(q0, lower + factor * reach), upper - factor * reach)

        def slow_enough(factor: Array) -> Array:
            middle, half = centre(factor), factor * reach
            return factor * speed <= s.share * limits.speed_between(middle - half, middle + half)

        factor = largest(factor, slow_enough)
        self.amplitude, self.centre = relative * factor[:, None], centre(factor)
        phase = rng.uniform(-np.pi, np.pi, shape)
        self.phase = _phases_through(phase, self.amplitude, q0 - self.centre)

    def bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """See the base class."""
        reach, speed, acceleration, jerk = (
            (self.amplitude * self.omega**k).sum(axis=1) for k in range(4)
        )
        bounds = ramped(speed, acceleration, jerk, self.settings)
        return self.centre - reach, self.centre + reach, *bounds


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
    motion: PathMotion,
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
    until = f"until somebody stops it (it comes to rest within {settings.stop_s:g} s)"
    if duration_s is not None:
        until = f"for {duration_s:g} s and {settings.stop_s:g} s of coming to rest"
    lines = [f"This moves {moving} joints, {until}."]
    if settings.slow_s:
        lines.append(
            f"The first {settings.slow_s:g} s go at {settings.slow_share:.0%} of the speed, "
            f"then within {settings.start_s:g} s to all of it."
        )
    for j, name in enumerate(joint_names):
        low, high = limits.lower[j], limits.upper[j]
        unit = "m" if any(limits.slides[j : j + 1]) else "rad"
        room = "its limits are not documented"
        if np.isfinite(low) and np.isfinite(high):
            margin = min(lower[j] - low, high - upper[j])
            room = f"limits {low:+.3f} .. {high:+.3f}, margin {margin:.3f} {unit}"
        fast = f"up to {speed[j]:.3f}"
        if settings.slow_s:
            fast = f"at first {settings.slow_share * speed[j]:.3f}, then {speed[j]:.3f}"
        turns = f"{math.degrees(lower[j]):+.1f} .. {math.degrees(upper[j]):+.1f} deg; "
        lines.append(
            f"{name:{width}}  {lower[j]:+.3f} .. {upper[j]:+.3f} {unit} "
            f"({'' if unit == 'm' else turns}{room}), {fast} {unit}/s "
            f"({speed[j] / fastest[j]:.0%} of {fastest[j]:.4g})"
        )
    lines.append(
        f"At most {np.max(acceleration / limits.acceleration):.0%} of the documented acceleration "
        f"and {np.max(jerk / limits.jerk):.0%} of the jerk of any joint."
    )
    return [*lines, HOW_TO_STOP]
