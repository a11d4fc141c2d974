"""Evidence: how much better data are explained with an effect than without it.

All is linear and Gaussian once the signals are white: with signatures X, prior standard
deviations s and data r, ln p(r) follows from the products X X^T and X r alone, so that thousands
of ways to explain a recording can be compared. What must be carried along whatever is compared
(the model's own inertial error, a small error of timing, the effects already named) is
eliminated by a Schur complement, which takes away from each signature what those explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_toeplitz

from adapter.model.spatial import Array


@dataclass(frozen=True, eq=False)
class Score:
    """What an explanation is worth.

    Attributes:
        log_evidence: ln of the ratio of marginal likelihoods, with over without.
        chi2: fall of the squared distance, in units of the noise.
        x: (k,) most probable coefficients.
    """

    log_evidence: float
    chi2: float
    x: Array


def score(G: Array, g: Array, prior_std: Array) -> Score:
    """Of signatures with products G (k, k), with the data g (k,)."""
    A = prior_std[:, None] * G * prior_std + np.eye(len(g))
    b = prior_std * g
    factor = cho_factor(A, lower=True)
    x = cho_solve(factor, b)
    chi2 = float(b @ x)
    log_det = 2.0 * float(np.log(np.diagonal(factor[0])).sum())
    return Score(0.5 * (chi2 - log_det), chi2, prior_std * x)


def scores(G: Array, g: Array, prior_std: Array) -> tuple[Array, Array, Array]:
    """(log_evidence (b,), chi2 (b,), x (b, k)) of stacks G (b, k, k), g (b, k).

    `prior_std` is (k,), or (b, k) where each has its own.
    """
    A = prior_std[..., :, None] * G * prior_std[..., None, :] + np.eye(G.shape[-1])
    right = prior_std * g
    x = np.linalg.solve(A, right[..., None])[..., 0]
    chi2 = np.einsum("bi,bi->b", right, x)
    return 0.5 * (chi2 - np.linalg.slogdet(A)[1]), chi2, prior_std * x


class Normal:
    """Least squares with a prior, by products of signatures: what is known of coefficients.

    Args:
        G: (c, c) products of white signatures with one another; g: (c,) with the data.
        prior_std: (c,) of the coefficients; the prior's mean is zero.

    Attributes:
        x: (c,) most probable coefficients.
    """

    def __init__(self, G: Array, g: Array, prior_std: Array) -> None:
        self.G, self.g, self.prior_std = G, g, prior_std
        self._factor = cho_factor(G + np.diag(prior_std**-2.0), lower=True)
        self.x = cho_solve(self._factor, g)

    def covariance(self) -> Array:
        """(c, c) of its coefficients after the data."""
        return np.asarray(cho_solve(self._factor, np.eye(len(self.g))))

    def std(self) -> Array:
        """(c,) of its coefficients after the data."""
        return np.sqrt(np.diagonal(self.covariance()))

    def part(self, at: np.ndarray) -> Normal:
        """Some of its coefficients alone."""
        return Normal(self.G[np.ix_(at, at)], self.g[at], self.prior_std[at])

    def worth(self, own: np.ndarray, rest: np.ndarray) -> Score:
        """Evidence of some of its coefficients, `rest` carried along with them."""
        G, C = self.G[np.ix_(own, own)], self.G[np.ix_(own, rest)]
        return score(*self.part(rest).reduced(G, C, self.g[own]), self.prior_std[own])

    def reduced(self, G: Array, C: Array, g: Array) -> tuple[Array, Array]:
        """(G, g) of further signatures once these have explained what they can.

        Products G (..., k, k) with one another, C (..., k, c) with these, g (..., k) with the data.
        """
        solved = self.solved(C)
        return G - solved @ np.swapaxes(C, -1, -2), g - solved @ self.g

    def solved(self, C: Array) -> Array:
        """C A^-1 of products C (..., c) with these, A their information."""
        flat = C.reshape(-1, C.shape[-1])
        return np.asarray(cho_solve(self._factor, flat.T).T.reshape(C.shape))


class Carried(Normal):
    """What is carried along, with its signatures.

    Args:
        N: (c, r) white signatures; prior_std: (c,); data: (r,) white residual.
    """

    def __init__(self, N: Array, prior_std: Array, data: Array) -> None:
        self.N, self.data = N, data
        super().__init__(N @ N.T, N @ data, prior_std)

    def without(self, X: Array) -> tuple[Array, Array]:
        """(G, g) of signatures X (k, r) once the carried ones have explained what they can."""
        return self.reduced(X @ X.T, X @ self.N.T, X @ self.data)


class Moments(Normal):
    """What is known of a fit's coefficients by a whole recording, by products alone.

    Attributes:
        folds: (f, c, c), (f, c), (f,): products of the white signatures with one
            another and with the data, and of the data, by blocks of time.
        seconds: (c, c) products of the gradients of single seconds with one another.
    """

    def __init__(self, folds: tuple[Array, Array, Array], prior_std: Array, seconds: Array) -> None:
        self.folds, self.seconds = folds, seconds
        super().__init__(folds[0].sum(axis=0), folds[1].sum(axis=0), prior_std)

    def under(self, prior_std: Array) -> Moments:
        """The same data under another prior."""
        return Moments(self.folds, prior_std, self.seconds)


ORDER = 6  # at 25 Hz
AT_ONCE = 8  # signatures that are whitened together
WHITE = 0.02  # share of white noise added: edges of models are not known any better
NOISE_WINDOW, SHORTEST_WINDOW = 128, 32  # samples, 5 s at most, and the least
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
        n, p = self.ar.shape
        k = x.shape[-2] - p
        flat = x.reshape(-1, (k + p) * n)  # long rows: numpy is slow along a handful of joints
        ratio = np.tile(np.column_stack([np.ones(n), -self.ar]).T / self.sigma, k)
        out, part = np.empty((len(flat), k * n)), np.empty((AT_ONCE, k * n))
        for first in range(0, len(flat), AT_ONCE):  # few enough to stay in the cache
            rows = flat[first : first + AT_ONCE]
            mine, scratch = out[first : first + AT_ONCE], part[: len(rows)]
            np.multiply(rows[:, p * n :], ratio[0], out=mine)
            for i in range(1, p + 1):
                np.multiply(rows[:, (p - i) * n : (p - i + k) * n], ratio[i], out=scratch)
                mine += scratch
        return np.asarray(out.reshape(*x.shape[:-2], k, n))


def noise_of(
    residual: Array,
    floor: float = LEAST_NM,
    windows: int = PLAIN,
    seams: Sequence[int] = (0,),
) -> Noise:
    """Noise model of a residual (k, n), N m.

    The spectrum is the median over windows of 5 s, so that what happens but once, a contact or
    a load that is picked up, does not count as noise.

    Args:
        floor: least standard deviation, N m.
        windows: at least so many; the more, the less does slow noise count in short recordings.
        seams: rows at which stretches begin, between which time is left out.
    """
    power = _spectrum(residual, windows) if len(seams) == 1 else _of_stretches(residual, seams)
    covariance = np.fft.ifft(power, axis=0).real[: ORDER + 1]
    covariance[0] += np.maximum(np.square(floor) - covariance[0], 0.0) + WHITE * covariance[0]
    n = residual.shape[1]
    ar, sigma = np.zeros((n, ORDER)), np.empty(n)
    for j in range(n):
        r = covariance[:, j]
        ar[j] = solve_toeplitz(r[:-1], r[1:])
        sigma[j] = np.sqrt(r[0] - ar[j] @ r[1:])
    return Noise(ar, sigma, np.sqrt(covariance[0]))


def _spectrum(residual: Array, windows: int) -> Array:
    """(f, n) power of a residual (k, n)."""
    from scipy.signal import welch  # takes a second; the learner's monitor has no use for it

    window = min(NOISE_WINDOW, max(len(residual) // windows, SHORTEST_WINDOW))
    _, power = welch(
        residual,
        window="hann",
        nperseg=window,
        axis=0,
        average="median",
        detrend="constant",
        return_onesided=False,
    )
    return np.asarray(power)


def _of_stretches(residual: Array, seams: Sequence[int]) -> Array:
    """(f, n) power of a residual (k, n), as Welch has it, by windows within its stretches."""
    from scipy.signal import spectrogram

    parts = [residual[a:b] for a, b in pairwise([*seams, len(residual)])]
    window = min(NOISE_WINDOW, *(len(part) for part in parts))
    powers = [
        spectrogram(
            part,
            window="hann",
            nperseg=window,
            noverlap=window // 2,
            axis=0,
            detrend="constant",
            return_onesided=False,
        )[2]
        for part in parts
    ]
    power = np.concatenate(powers, axis=-1)
    # what the median of so many exponential variables is to their mean
    even = 2.0 * np.arange(1.0, (power.shape[-1] - 1) // 2 + 1)
    bias = 1.0 + float(np.sum(1.0 / (even + 1.0) - 1.0 / even))
    return np.asarray(np.median(power, axis=-1) / bias)
