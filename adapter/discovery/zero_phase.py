"""The one filter of discovery: zero phase, the same for every signal, then thinned out."""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.spatial import Array

CUTOFF_SHARE = 0.2  # of the sample rate, the highest corner that is used
ORDER = 4  # of the filter, run forwards and backwards
KEPT_PER_CUTOFF = 4.0  # samples kept per period of the corner frequency


class ZeroPhase:
    """Zero-phase Butterworth, then every so many samples.

    Attributes:
        cutoff_hz: its corner, lower than asked for where the sample rate wants it.
        step: one in so many samples is kept; edge: so many at either end are not.
        passes: share of the variance of white noise that passes.
        rate_passes: variance of the rate of change of filtered white noise of variance one, 1/s².
    """

    def __init__(self, rate_hz: float, cutoff_hz: float) -> None:
        self.rate_hz = rate_hz
        self.cutoff_hz = min(cutoff_hz, CUTOFF_SHARE * rate_hz)
        self._sos = butter(ORDER, self.cutoff_hz, fs=rate_hz, output="sos")
        self.step = max(1, int(rate_hz / (KEPT_PER_CUTOFF * self.cutoff_hz)))
        self.edge = int(np.ceil(rate_hz / self.cutoff_hz))
        # share of white noise that passes, and of its rate of change
        f = np.linspace(0.0, rate_hz / 2, 4000)
        passes = 1.0 / (1.0 + (f / self.cutoff_hz) ** (2 * ORDER)) ** 2
        self.passes = float(np.mean(passes))
        self.rate_passes = float(np.mean(passes * (2 * np.pi * f) ** 2))

    def __call__(self, x: Array) -> Array:
        flat = x.reshape(len(x), -1)
        return np.asarray(sosfiltfilt(self._sos, flat, axis=0)).reshape(x.shape)

    def rate_of(self, smooth: Array) -> Array:
        """d/dt of what was filtered at full rate."""
        return np.asarray(np.gradient(smooth, 1.0 / self.rate_hz, axis=0))
