"""Coloured noise: an autoregressive model per joint, and whitening by it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import welch

from adapter.records import Array

ORDER = 6  # at 25 Hz
WHITE = 0.02  # share of white noise added: edges of models are not known any better
WINDOW, SHORTEST = 128, 32  # samples, 5 s at most, and the least
ROBUST, PLAIN = 5, 2  # windows at least: where something may be in a few of them, and else
LEAST_NM = 1e-4  # N m; no torque sensor is quieter


@dataclass(frozen=True, eq=False)
class Noise:
    """What the residual is made of once everything that can be explained is.

    Attributes:
        ar: (n, p) coefficients; x_t = sum ar_i x_(t-i) + e_t.
        sigma: (n,) standard deviation of e, N m.
        level: (n,) standard deviation of x in the band, N m.
    """

    ar: Array
    sigma: Array
    level: Array

    def flat(self) -> Noise:
        """White noise of the same size in the band."""
        return Noise(np.zeros_like(self.ar), self.level, self.level)

    def whiten(self, x: Array) -> Array:
        """Signals (..., k, n) made white and of unit variance, (..., k - p, n)."""
        p = self.ar.shape[1]
        out = x[..., p:, :].copy()
        for i in range(p):
            out -= self.ar[:, i] * x[..., p - 1 - i : x.shape[-2] - 1 - i, :]
        out /= self.sigma
        return np.asarray(out)


def noise_of(residual: Array, floor: float = LEAST_NM, windows: int = PLAIN) -> Noise:
    """Noise model of a residual (k, n), N m.

    The spectrum is the median over windows of 5 s, so that what happens but once, a contact or
    a load that is picked up, does not count as noise.

    Args:
        floor: least standard deviation, N m.
        windows: at least so many; the more, the less does slow noise count in short recordings.
    """
    window = min(WINDOW, max(len(residual) // windows, SHORTEST))
    _, power = welch(
        residual,
        window="hann",
        nperseg=window,
        axis=0,
        average="median",
        detrend="constant",
        return_onesided=False,
    )
    covariance = np.fft.ifft(power, axis=0).real[: ORDER + 1]
    covariance[0] += np.maximum(np.square(floor) - covariance[0], 0.0) + WHITE * covariance[0]
    n = residual.shape[1]
    ar, sigma = np.zeros((n, ORDER)), np.empty(n)
    for j in range(n):
        r = covariance[:, j]
        ar[j] = solve_toeplitz(r[:-1], r[1:])
        sigma[j] = np.sqrt(r[0] - ar[j] @ r[1:])
    return Noise(ar, sigma, np.sqrt(covariance[0]))
