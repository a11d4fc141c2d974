"""Memory of the noise: what an arm's model gets wrong keeps its sign for a while.

It is ten times the sensors' noise on a real arm, and correlated over tenths of a second. So many
samples say the same; a fit counts them once, and whitens nothing: under coloured noise it would be
the fast rest that weighs a load.
"""

from __future__ import annotations

import numpy as np

from adapter.model.spatial import Array

LEAST_NM = 1e-4  # N m; no torque sensor is quieter, and nothing explains a joint better
# Least and most: a band of 10 Hz, an arm's misfit; before the data, as sure as so many numbers
# make it. Of a few seconds the slow parts are fitted away, by so many coefficients a joint.
MEMORY_S, USUAL_S, SURE, FITTED = (0.05, 0.5), 0.1, 10.0, 10.0


def memory_s(left: Array, period_s: float, rows: Array | None = None) -> Array:
    """(n,) s of noise (m, n) that one independent sample stands for (Newey and West 1987).

    Args:
        rows: (n,) of these that count, all where None.
    """
    lags = max(round(MEMORY_S[1] / period_s), 1)
    centred = left - left.mean(axis=0)
    power = np.abs(np.fft.rfft(centred, 2 * len(left), axis=0)) ** 2
    alike = np.fft.irfft(power, axis=0)[:lags]
    alike /= np.maximum(alike[0], 1e-12)
    fading = 1.0 - np.arange(len(alike)) / lags
    shown = period_s * (2.0 * fading @ alike - 1.0)
    free = 3.0 * (len(left) if rows is None else rows) / lags  # numbers that it is a mean of
    known = (SURE * USUAL_S + free * shown) / (SURE + np.maximum(free - FITTED, 0.0))
    return np.clip(known, *MEMORY_S)
