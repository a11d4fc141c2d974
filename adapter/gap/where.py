"""Where model and data disagree: which signals the residual of each joint follows."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.gap.result import Curves
from adapter.records import Array

BINS = 12
SIGNALS = ("q", "dq", "ddq", "tau")


def disagreement(curves: Curves, noise_floor_nm: Array) -> list[dict[str, Any]]:
    """Of the nominal model, joint by joint.

    Returns:
        One entry a joint (from 1): `rmse_nm`, `times_noise`, and `follows`: the share of the
        residual's power that its mean by velocity, position, acceleration, load (the joint's
        own) and time explains, beyond what as many bins of pure noise would.
    """
    out = []
    for j in range(curves.before.shape[1]):
        residual = curves.before[:, j]
        rmse = float(np.sqrt(np.mean(residual**2)))
        signals = {f"{name}{j + 1}": getattr(curves, name)[:, j] for name in SIGNALS}
        signals["t"] = curves.t
        shares = {name: explained(residual, x) for name, x in signals.items()}
        out.append(
            {
                "joint": j + 1,
                "rmse_nm": rmse,
                "times_noise": rmse / float(noise_floor_nm[j]),
                "follows": dict(sorted(shares.items(), key=lambda pair: -pair[1])),
            }
        )
    return out


def explained(residual: Array, x: Array) -> float:
    """Share of the power of a residual (k,) in its means over bins of x (k,), noise discounted."""
    order = np.argsort(x, kind="stable")
    parts = np.array_split(residual[order], BINS)
    between = sum(len(p) * float(p.mean()) ** 2 for p in parts)
    whole = float(residual @ residual)
    if not whole > 0.0:
        return 0.0
    by_chance = BINS * (whole - between) / max(len(residual) - BINS, 1)
    return float(np.clip((between - by_chance) / whole, 0.0, 1.0))
