"""What an arm is about to do, in lines for the person beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adapter.excitation import MotionLimits, RandomMotion
from adapter.records import Array

HOW_TO_STOP = (
    "To stop: Ctrl-C (or SIGTERM, or close this terminal); a second Ctrl-C stops at once. Keep a "
    "hand on the emergency stop: it is the only one that needs no software."
)


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
    width = max(len(name) for name in joint_names)
    lines = [f"This moves {len(joint_names)} joints, {_until(duration_s, settings.stop_s)}."]
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
            f"({_share(speed[j], limits.velocity[j])} of {limits.velocity[j]:.4g})"
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
