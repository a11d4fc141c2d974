"""Noisy signals of one trajectory into samples: one zero-phase filter for all, then differences.

Offline nothing needs to be causal: the same Butterworth low-pass runs forwards and backwards over
every signal, so all keep one and the same instant, and what is filtered alike stays consistent
(the models are linear in slow products of them). Accelerations are central differences of the
filtered velocities. The ends, where the filter has seen too little, are cut off.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.errors import ModelError
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import Array
from adapter.model.tree import Tree

RATE_HZ = 1000.0  # samples a second
# Corner of the low-pass, well above the motion's fastest and well below the noise's, and its order;
# it runs twice.
BANDWIDTH_HZ, ORDER = 20.0, 4
CUT = 200  # samples taken off both ends; the filter's transients fade within 2 / bandwidth


def smoothed_data(
    tree: Tree, measured: Mapping[str, Array], gravity: Array | None = None
) -> TreeData:
    """Samples of one trajectory; a floating base's wrench is zero (free fall).

    Args:
        tree: N and A.
        measured: what the sensors of one trajectory read (m, ...), at a constant rate, without
            holes: q, dq (m, n) rad, rad/s; tau (m, n) joint torques, N m; base_w, base_a (m, 3)
            rad/s, m/s² with gravity, none with a fixed base; link_w, link_a (m, n, 3) of every
            moving link, at its frame, where links have them; base_v, link_v velocities, m/s, where
            something measures them.
        gravity: (3,) in base axes, m/s²; needed with a fixed base, whose motion is that of rest.

    Raises:
        ModelError: signals that are missing, too short, of other lengths, or not finite.
    """
    m, least = len(measured["q"]), 2 * CUT + 30 * ORDER
    if m < least:
        raise ModelError(f"a trajectory needs at least {least} samples, got {m}")
    for name, x in measured.items():
        if len(x) != m or not np.isfinite(x).all():
            raise ModelError(f"{name} must hold {m} samples, all finite")
    sos = butter(ORDER, BANDWIDTH_HZ, fs=RATE_HZ, output="sos")
    smooth = {name: sosfiltfilt(sos, x, axis=0) for name, x in measured.items()}

    def rate(name: str) -> Array:
        return np.asarray(np.gradient(smooth[name], 1.0 / RATE_HZ, axis=0))

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
    return data.take(slice(CUT, m - CUT))
