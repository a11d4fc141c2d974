"""Memory of the noise: what an arm's model gets wrong keeps its sign for a while.

It is ten times the sensors' noise on a real arm, and correlated over tenths of a second. So many
samples say the same; a fit counts them once, and whitens nothing: under coloured noise it would be
the fast rest that weighs a load.
"""

from __future__ import annotations

import numpy as np

from adapter.model.spatial import Array

LEAST_NM = 1e-4  # N m; no torque sensor is quieter, and nothing explains a joint better
MEMORY_S = (0.1, 0.5)  # least and most: the band's 10 Hz, and an arm's misfit


def memory_s(left: Array, period_s: float) -> Array:
    """(n,) s of noise (m, n) that one independent sample stands for (Newey and West 1987)."""
    lags = max(round(MEMORY_S[1] / period_s), 1)
    centred = left - left.mean(axis=0)
    power = np.abs(np.fft.rfft(centred, 2 * len(left), axis=0)) ** 2
    alike = np.fft.irfft(power, axis=0)[:lags]
    alike /= np.maximum(alike[0], 1e-12)
    fading = 1.0 - np.arange(len(alike)) / lags
    return np.clip(period_s * (2.0 * fading @ alike - 1.0), *MEMORY_S)
