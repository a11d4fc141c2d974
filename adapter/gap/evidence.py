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

from adapter.records import Array


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


def scores(G: Array, g: Array, prior_std: Array) -> tuple[Array, Array]:
    """(log_evidence, chi2), (b,) each, of stacks G (b, k, k), g (b, k)."""
    A = prior_std[:, None] * G * prior_std + np.eye(G.shape[-1])
    right = prior_std * g
    chi2 = np.einsum("bi,bi->b", right, np.linalg.solve(A, right[..., None])[..., 0])
    return 0.5 * (chi2 - np.linalg.slogdet(A)[1]), chi2


class Carried:
    """What is carried along: its signatures, their priors, and what they do to others.

    Args:
        N: (c, r) white signatures; prior_std: (c,); data: (r,) white residual.
    """

    def __init__(self, N: Array, prior_std: Array, data: Array) -> None:
        self.N, self.prior_std, self.data = N, prior_std, data
        self.g = N @ data
        information = N @ N.T
        information[np.diag_indices(len(N))] += prior_std**-2.0
        self._factor = cho_factor(information, lower=True)
        self.x = cho_solve(self._factor, self.g)

    def covariance(self) -> Array:
        """(c, c) of its coefficients after the data."""
        return np.asarray(cho_solve(self._factor, np.eye(len(self.N))))

    def std(self) -> Array:
        """(c,) of its coefficients after the data."""
        return np.sqrt(np.diagonal(self.covariance()))

    def without(self, X: Array) -> tuple[Array, Array]:
        """(G, g) of signatures X (k, r) once the carried ones have explained what they can."""
        return self.reduced(X @ X.T, X @ self.N.T, X @ self.data)

    def reduced(self, G: Array, C: Array, g: Array) -> tuple[Array, Array]:
        """The same from products: G (..., k, k), C (..., k, c) with the carried, g (..., k)."""
        flat = C.reshape(-1, C.shape[-1])
        solved = cho_solve(self._factor, flat.T).T.reshape(C.shape)
        return G - solved @ np.swapaxes(C, -1, -2), g - solved @ self.g
