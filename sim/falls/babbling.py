"""Motor babbling: random smooth joint motion inside the limits, for a controller to follow."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sim.falls.tree_truth import TreeLimits
from sim.truth import Array


@dataclass(frozen=True, slots=True)
class Babbling:
    """How a robot babbles: each joint follows a sum of sines of its own about its middle.

    Slow and smooth on purpose: a pure-feedback controller can follow it, joints of a humanoid
    use most of their range at up to `top_speed`, and torques come from the motion of limbs and
    not from jerks at joints.

    Attributes:
        sines: per joint.
        low_hz: lowest frequency; a joint's frequencies are spread evenly over the band.
        high_hz: highest frequency.
        share: of the joint's range that the wanted motion spans at most; the rest is left for the
            controller's error.
        top_speed: of a joint, rad/s; its motion gets smaller where it would be faster.
        speed_share: of the joint's own speed limit, likewise.
        tumble: rms angular velocity of the base at the start, rad/s per axis.
    """

    sines: int = 3
    low_hz: float = 0.15
    high_hz: float = 0.75
    share: float = 0.8
    top_speed: float = 4.0
    speed_share: float = 0.5
    tumble: float = 0.3

    def __post_init__(self) -> None:
        if self.sines < 1 or not 0 < self.low_hz <= self.high_hz:
            raise ValueError("babbling needs a sine or more and 0 < low_hz <= high_hz")
        if not (0 < self.share <= 1 and 0 < self.speed_share <= 1 and self.top_speed > 0):
            raise ValueError("share and speed_share must be in (0, 1], top_speed above 0")
        if not self.tumble >= 0:
            raise ValueError(f"tumble must be 0 or more, got {self.tumble}")

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        return asdict(self)


def plan(
    limits: TreeLimits, t: Array, settings: Babbling, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Wanted positions and velocities of all joints.

    Args:
        limits: of n joints.
        t: (m,) s.
        settings: of the motion.
        rng: all that is random comes from it.

    Returns:
        q (m, n) rad inside the limits and dq (m, n) rad/s.
    """
    n = len(limits.lower)
    edges = np.linspace(settings.low_hz, settings.high_hz, settings.sines + 1)[:, None]
    rate = 2 * np.pi * (edges[:-1] + (edges[1:] - edges[:-1]) * rng.random((settings.sines, n)))
    phase = rng.uniform(0, 2 * np.pi, (settings.sines, n))
    size = rng.uniform(0.5, 1.0, (settings.sines, n)) * rate.min(axis=0) / rate
    q, dq = np.zeros((len(t), n)), np.zeros((len(t), n))
    for a, w, f in zip(size, rate, phase, strict=True):
        angle = np.outer(t, w) + f
        q += a * np.sin(angle)
        dq += a * w * np.cos(angle)
    half = settings.share * (limits.upper - limits.lower) / 2
    fastest = np.minimum(settings.top_speed, settings.speed_share * limits.velocity)
    scale = np.minimum(half / np.abs(q).max(axis=0), fastest / np.abs(dq).max(axis=0))
    return (limits.lower + limits.upper) / 2 + scale * q, scale * dq
