"""Evidence: how much better data are explained with an effect than without it.

All is linear and Gaussian once the signals are white: with signatures X, prior standard
deviations s and data r, ln p(r) follows from the products X X^T and X r alone, so that thousands
of ways to explain a recording can be compared. What must be carried along whatever is compared
(the model's own inertial error, a small error of timing, the effects already named) is
eliminated by a Schur complement, which takes away from each signature what those explain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from adapter.judgement.noise import LEAST_NM, MEMORY_S, memory_s
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
        folds: (f, c, c), (f, c): products of the white signatures with one another and with the
            data, by blocks of time.
        seconds: (c, c) products of the gradients of single seconds with one another.
    """

    def __init__(self, folds: tuple[Array, Array], prior_std: Array, seconds: Array) -> None:
        self.folds, self.seconds = folds, seconds
        super().__init__(folds[0].sum(axis=0), folds[1].sum(axis=0), prior_std)

    def under(self, prior_std: Array) -> Moments:
        """The same data under another prior."""
        return Moments(self.folds, prior_std, self.seconds)


BAND_HZ = 25.0  # samples a second


@dataclass(frozen=True, eq=False)
class Noise:
    """What a model leaves, with memory: the sensors' noise, and what it gets wrong for a while.

    Rows are as many as its memory lets be independent, and none is whitened: what an arm's model
    gets wrong is slow, and under coloured noise it would be the fast rest that weighs a load.

    Attributes:
        level: (n,) standard deviation in the band, N m.
        memory: (n,) samples of the band that say the same.
    """

    level: Array
    memory: Array

    def whiten(self, x: Array) -> Array:
        """Signals (..., k, n) of unit variance for as many rows as are independent."""
        return np.asarray(x / (self.level * np.sqrt(self.memory)))


def noise_of(residual: Array, weight: Array | None = None) -> Noise:
    """Noise of a residual (k, n), N m, whose rows count as `weight` (k, n), alike where None."""
    weight = np.ones_like(residual) if weight is None else weight
    left = residual * weight
    rows = np.maximum(np.sum(weight**2, axis=0), 1.0)
    level = np.sqrt(np.sum(left**2, axis=0) / rows + LEAST_NM**2)
    return Noise(level, BAND_HZ * memory_s(left, 1.0 / BAND_HZ))


def quiet_noise(residual: Array, weight: Array) -> Noise:
    """Noise of a residual (k, n), N m, as it is in most windows of it, about their means.

    Rows count as `weight` (k, n), windows as often as rows of them do.

    What happens but once, a contact or a load that is picked up, is no noise then, and what comes
    in at some time and stays is none.
    """
    k = max(len(residual) // 50, 1)  # samples, 2 s
    left, rows = (x[: k * (len(x) // k)].reshape(k, -1, x.shape[1]) for x in (residual, weight**2))
    count = np.maximum(rows.sum(axis=1), 1e-9)
    mean = np.sum(rows * left, axis=1) / count
    spread = np.sum(rows * (left - mean[:, None]) ** 2, axis=1) / count
    middle = np.quantile(spread, 0.5, axis=0, weights=count, method="inverted_cdf")
    level = np.sqrt(middle + LEAST_NM**2)
    return Noise(level, np.full(len(level), BAND_HZ * MEMORY_S[0]))
