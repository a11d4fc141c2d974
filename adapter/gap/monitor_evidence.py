"""How much better the last seconds are explained with a candidate than without.

Linear and Gaussian throughout: torque = Z x + S a + noise, where x (inertias, learned effects,
disagreements reported before) is known with the information of all that was seen before, and
the candidate's coefficients a act from some start on. The evidence of a candidate is

    L = 1/2 b^T (G + P)^-1 b - 1/2 ln det(I + G P^-1) + log odds,

G and b its information and right side with x integrated out, P the prior's information.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from adapter.gap.monitor_signatures import Candidate
from adapter.records import Array


class Belief:
    """What is known of x: information matrix and right side.

    Args:
        H: (D, D); rhs: (D,).
    """

    def __init__(self, H: Array, rhs: Array) -> None:
        self.H, self.rhs = H.copy(), rhs.copy()
        self._floor = 1e-3 * H.diagonal()

    def absorb(self, Z: Array, weight: Array, tau: Array, keep: float) -> None:
        """Add rows Z (r, D), tau (r,) of these weights; `keep` is the share of the old kept.

        What fades gives way to a thousandth of what was known at first, around the same mean.
        """
        own = np.zeros(len(self.rhs))
        own[: len(self._floor)] = (1.0 - keep) * self._floor
        mean = self.mean()
        self.H *= keep
        self.rhs *= keep
        self.H[np.diag_indices_from(self.H)] += own
        self.rhs += own * mean
        weighted = Z * weight[:, None]
        self.H += weighted.T @ Z
        self.rhs += weighted.T @ tau

    def mean(self) -> Array:
        """(D,)."""
        return np.asarray(np.linalg.solve(self.H, self.rhs))

    def extend(self, std: Array) -> None:
        """New coefficients behind the others: zero give or take std (k,)."""
        size, k = len(self.rhs), len(std)
        H = np.zeros((size + k, size + k))
        H[:size, :size] = self.H
        H[np.arange(size, size + k), np.arange(size, size + k)] = 1.0 / std**2
        self.H, self.rhs = H, np.r_[self.rhs, np.zeros(k)]

    def drop(self, at: slice) -> None:
        """Integrate out the coefficients there."""
        size = len(self.rhs)
        rest = np.r_[: at.start, at.stop : size]
        gain = np.linalg.solve(self.H[at, at], np.c_[self.H[at, rest], self.rhs[at]])
        cross = self.H[np.ix_(rest, np.arange(size)[at])]
        self.rhs = self.rhs[rest] - cross @ gain[:, -1]
        self.H = self.H[np.ix_(rest, rest)] - cross @ gain[:, :-1]


@dataclass(frozen=True)
class Rows:
    """The last seconds, in groups of rows one after the other: g groups of r rows.

    Attributes:
        t: (g r,) s; Z: (g r, n, D); S: (g r, n, K); tau: (g r, n); weight: (g r, n).
    """

    t: Array
    Z: Array
    S: Array
    tau: Array
    weight: Array


class Evidence:
    """Evidence of any candidate from any start, on rows and a belief.

    Args:
        rows: the last seconds.
        belief: from before them.
    """

    def __init__(self, rows: Rows, belief: Belief) -> None:
        self.rows = rows
        root = np.sqrt(rows.weight)
        self._Z = rows.Z * root[:, :, None]
        self._S = rows.S * root[:, :, None]
        mean = belief.mean()
        self.residual = rows.tau - rows.Z @ mean
        self._r = self.residual * root
        D = len(mean)
        flat = self._Z.reshape(-1, D)
        self.factor = np.linalg.cholesky(belief.H + flat.T @ flat)
        # well enough conditioned for its inverse, and products are much faster than solutions
        self._inverse = solve_triangular(self.factor, np.eye(D), lower=True, check_finite=False)
        self._pull = self._inverse @ (flat.T @ self._r.ravel())

    @property
    def total(self) -> float:
        """ln of how likely the rows are, up to what all models with the same belief share."""
        fit = self._pull @ self._pull - np.sum(self._r**2)
        return float(0.5 * fit - np.sum(np.log(self.factor.diagonal())))

    @cached_property
    def shift(self) -> Array:
        """(D,) by which the rows move the belief's mean."""
        return np.asarray(self._inverse.T @ self._pull)

    def information(self, step: int, columns: np.ndarray | None = None) -> tuple[Array, Array]:
        """(s, k, k) G and (s, k) b for starts at every `step` rows, the first row first."""
        S = self._S if columns is None else self._S[:, :, columns]
        D, K = self._Z.shape[2], S.shape[2]
        blocks = len(S) // step
        Zb = self._Z.reshape(blocks, -1, D).transpose(0, 2, 1)
        Sb = S.reshape(blocks, -1, K)
        rb = self._r.reshape(blocks, -1, 1)
        back = slice(None, None, -1)
        B = np.cumsum((Zb @ Sb)[back], axis=0)[back]
        C = np.cumsum((Sb.transpose(0, 2, 1) @ Sb)[back], axis=0)[back]
        b = np.cumsum((Sb.transpose(0, 2, 1) @ rb)[back], axis=0)[back][:, :, 0]
        X = self._inverse @ B
        return C - X.transpose(0, 2, 1) @ X, b - self._pull @ X

    def from_row(self, first: int) -> tuple[Array, Array]:
        """(K, K) G and (K,) b of all columns for a start at one row."""
        K = self._S.shape[2]
        S = self._S[first:].reshape(-1, K)
        B = self._Z[first:].reshape(len(S), -1).T @ S
        X = self._inverse @ B
        b = S.T @ self._r[first:].ravel() - X.T @ self._pull
        return S.T @ S - X.T @ X, b

    def leftover(self, candidate: Candidate, a: Array, first: int) -> Array:
        """(rows, n) residual that stays when the candidate acts with coefficients a."""
        added = self.rows.S[:, :, candidate.columns] @ a
        added[:first] = 0.0
        root = np.sqrt(self.rows.weight)
        D = self._Z.shape[2]
        right = self._Z.reshape(-1, D).T @ (self._r - added * root).ravel()
        shift = self._inverse.T @ (self._inverse @ right)
        return np.asarray(self.residual - added - self.rows.Z @ shift)


def log_evidence(candidate: Candidate, G: Array, b: Array) -> Array:
    """(s,) L of a candidate from its own G (s, k, k) and b (s, k)."""
    prior = 1.0 / candidate.std**2
    if len(prior) == 1:
        g, x = G[:, 0, 0], b[:, 0]
        found = 0.5 * x * x / (g + prior[0]) - 0.5 * np.log1p(np.maximum(g, 0.0) / prior[0])
        return np.asarray(found + candidate.log_odds)
    M = G + np.diag(prior)
    gain = np.linalg.solve(M, b[:, :, None])[:, :, 0]
    _, size = np.linalg.slogdet(M)
    found = 0.5 * np.einsum("sk,sk->s", b, gain) - 0.5 * (size - np.log(prior).sum())
    return np.asarray(found + candidate.log_odds)


def coefficients(candidate: Candidate, G: Array, b: Array) -> Array:
    """(k,) most likely coefficients from G (k, k) and b (k,)."""
    return np.asarray(np.linalg.solve(G + np.diag(1.0 / candidate.std**2), b))
