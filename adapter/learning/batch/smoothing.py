"""Noisy signals of one trajectory into samples: one zero-phase filter for all, then differences.

Offline nothing needs to be causal: the same Butterworth low-pass runs forwards and backwards over
every signal, so all keep one and the same instant, and what is filtered alike stays consistent
(the models are linear in slow products of them). Accelerations are central differences of the
filtered velocities. The ends, where the filter has seen too little, are cut off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.errors import ModelError
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import Array
from adapter.model.tree import Tree


@dataclass(frozen=True)
class SmoothingSettings:
    """How signals are smoothed.

    Attributes:
        rate_hz: samples a second.
        bandwidth_hz: corner of the low-pass; well above the motion's fastest, well below the
            noise's.
        order: of the Butterworth filter, which runs twice.
        cut_s: taken off both ends, s; the filter's transients fade within 2 / bandwidth.
    """

    rate_hz: float = 1000.0
    bandwidth_hz: float = 20.0
    order: int = 4
    cut_s: float = 0.2

    def __post_init__(self) -> None:
        for name in ("rate_hz", "bandwidth_hz"):
            if not getattr(self, name) > 0.0:
                raise ModelError(f"{name} must be above zero, got {getattr(self, name)}")
        if self.bandwidth_hz >= 0.5 * self.rate_hz:
            raise ModelError(
                f"bandwidth_hz {self.bandwidth_hz} must lie below half the rate, "
                f"{0.5 * self.rate_hz} Hz"
            )
        if self.order < 1 or not self.cut_s >= 0.0:
            raise ModelError("order must be at least 1 and cut_s 0 or more")


@dataclass(frozen=True)
class Measured:
    """What the sensors of one trajectory read, (m, ...) at a constant rate.

    Attributes:
        q, dq: (m, n) rad, rad/s; tau: (m, n) joint torques, N m.
        base_w, base_a: (m, 3) rad/s, m/s² with gravity; None with a fixed base.
        link_w, link_a: (m, n, 3) of every moving link, at its frame; None where no link has one.
        base_v, link_v: velocities, m/s, where something measures them.
    """

    q: Array
    dq: Array
    tau: Array
    base_w: Array | None = None
    base_a: Array | None = None
    link_w: Array | None = None
    link_a: Array | None = None
    base_v: Array | None = None
    link_v: Array | None = None


def smoothed_data(
    tree: Tree,
    measured: Measured,
    settings: SmoothingSettings | None = None,
    gravity: Array | None = None,
) -> TreeData:
    """Samples of one trajectory; a floating base's wrench is zero (free fall).

    Args:
        tree: N and A.
        measured: at a constant rate, without holes.
        settings: see `SmoothingSettings`.
        gravity: (3,) in base axes, m/s²; needed with a fixed base, whose motion is that of rest.

    Raises:
        ModelError: signals that are missing, too short, of other lengths, or not finite.
    """
    settings = settings or SmoothingSettings()
    given = {name: x for name, x in vars(measured).items() if x is not None}
    m = len(measured.q)
    cut = round(settings.cut_s * settings.rate_hz)
    least = 2 * cut + 30 * settings.order
    if m < least:
        raise ModelError(f"a trajectory needs at least {least} samples, got {m}")
    for name, x in given.items():
        if len(x) != m or not np.isfinite(x).all():
            raise ModelError(f"{name} must hold {m} samples, all finite")
    sos = butter(settings.order, settings.bandwidth_hz, fs=settings.rate_hz, output="sos")
    smooth = {name: sosfiltfilt(sos, x, axis=0) for name, x in given.items()}

    def rate(name: str) -> Array:
        return np.asarray(np.gradient(smooth[name], 1.0 / settings.rate_hz, axis=0))

    def motion(kind: str) -> BodyMotion | None:
        w, a = (smooth.get(f"{kind}_{s}") for s in "wa")
        if w is None or a is None:
            return None
        return BodyMotion(w, a, rate(f"{kind}_w"), smooth.get(f"{kind}_v"))

    if tree.floating:
        base = motion("base")
    elif gravity is None:
        raise ModelError("a fixed base needs gravity, the direction of which its rest shows")
    else:
        zero = np.zeros((m, 3))
        base = BodyMotion(zero, zero - np.asarray(gravity, dtype=float), zero, zero)
    if base is None:
        raise ModelError("a floating base needs its own base_w and base_a, and one is missing")
    tau = smooth["tau"]
    if tree.floating:
        tau = np.concatenate([np.zeros((m, 6)), tau], axis=1)
    data = TreeData(tree, smooth["q"], smooth["dq"], rate("dq"), tau, base, motion("link"))
    return data.take(slice(cut, m - cut))
