"""How much better the last seconds are explained with a candidate than without.

Linear and Gaussian throughout: torque = Z x + S a + noise, where x (inertias, learned effects,
disagreements reported before) is known with the information of all that was seen before, and
the candidate's coefficients a act from some start on. The evidence of a candidate is

    L = 1/2 b^T (G + P)^-1 b - 1/2 ln det(I + G P^-1) + log odds,

G and b its information and right side with x integrated out, P the prior's information.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from adapter.gap.monitor_signatures import Signature
from adapter.model.spatial import Array

ROWS_PER_GROUP = 5
CLIP = 9.0  # times its level: what a row says at most about the level
LEVEL_ROWS, LEVEL_SUMS = 250.0, 40.0  # rows and sums that the level is averaged over
START_SUMS = 5.0  # that the first guess of the level counts


class Belief:
    """What is known of x: information matrix and right side.

    Args:
        H: (D, D); rhs: (D,).

    Attributes:
        drift: (D,) variance by which a coefficient differs from one window to the next.
    """

    def __init__(self, H: Array, rhs: Array) -> None:
        self.H, self.rhs = H.copy(), rhs.copy()
        self._floor = 1e-3 * H.diagonal()
        self._mean: Array | None = None
        self.drift = np.zeros(len(rhs))

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
        self._mean = None

    def mean(self) -> Array:
        """(D,); nobody may write to it."""
        if self._mean is None:
            self._mean = np.asarray(np.linalg.solve(self.H, self.rhs))
        return self._mean

    def std(self) -> Array:
        """(D,) standard deviations."""
        return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(self.H))))

    def widened(self, variance: Array) -> Array:
        """(D, D) information where coefficients vary by so much (D,) beyond what is known."""
        at = np.flatnonzero(variance)
        across = self.H[:, at]
        own = np.diag(1.0 / variance[at]) + across[at]
        return np.asarray(self.H - across @ np.linalg.solve(own, across.T))

    def widen(self, variance: Array) -> None:
        """Know coefficients by a variance (D,) less, about the same mean."""
        mean, self.H = self.mean(), self.widened(variance)
        self.rhs, self._floor = self.H @ mean, 1e-3 * self.H.diagonal()

    def extend(self, std: Array) -> None:
        """New coefficients behind the others: zero give or take std (k,)."""
        size, k = len(self.rhs), len(std)
        H = np.zeros((size + k, size + k))
        H[:size, :size] = self.H
        H[np.arange(size, size + k), np.arange(size, size + k)] = 1.0 / std**2
        self.H, self.rhs, self._mean = H, np.r_[self.rhs, np.zeros(k)], None
        self.drift = np.r_[self.drift, np.zeros(k)]

    def drop(self, at: slice) -> None:
        """Integrate out the coefficients there."""
        size = len(self.rhs)
        rest = np.r_[: at.start, at.stop : size]
        gain = np.linalg.solve(self.H[at, at], np.c_[self.H[at, rest], self.rhs[at]])
        cross = self.H[np.ix_(rest, np.arange(size)[at])]
        self.rhs, self.drift = self.rhs[rest] - cross @ gain[:, -1], self.drift[rest]
        self._floor = self._floor[rest[rest < len(self._floor)]]
        self.H = self.H[np.ix_(rest, rest)] - cross @ gain[:, :-1]
        self._mean = None


@dataclass(frozen=True, eq=False)
class RowGroup:
    """Rows one after the other, with all that is computed of them once.

    Attributes:
        t: (r,) s.
        Z: (r, n, D) regressor and columns of the learned effects.
        S: (r, n, K) signatures; tau: (r, n) N m.
        unsure: (r, n) variance that no model of these rows can do without, (N m)².
        rates: (r, 2 n) velocities and accelerations, rad/s and rad/s².
        new: (r, n) 1 where one of a joint's is beyond what the belief has seen, else 0.
    """

    t: Array
    Z: Array
    S: Array
    tau: Array
    unsure: Array
    rates: Array
    new: Array

    @property
    def doubt(self) -> Array:
        """(r, n) `unsure`, and all but infinite where the belief foretells nothing, (N m)²."""
        return self.unsure + 1e12 * self.new  # (N m)²

    @classmethod
    def joined(cls, groups: Sequence[RowGroup]) -> RowGroup:
        """One group of all rows of several."""
        keys = [x.name for x in fields(cls)]
        return cls(*(np.concatenate([getattr(group, key) for group in groups]) for key in keys))


class Evidence:
    """Evidence of any candidate from any start, on rows and a belief.

    Args:
        rows: the last seconds; weight: (r, n) of each row on each joint.
        belief: from before them.
    """

    def __init__(self, rows: RowGroup, weight: Array, belief: Belief) -> None:
        self.rows, self.weight = rows, weight
        root = np.sqrt(weight)
        self._Z = rows.Z * root[:, :, None]
        self._S = rows.S * root[:, :, None]
        mean = belief.mean()
        self.residual = rows.tau - rows.Z @ mean
        self._r = self.residual * root
        D = len(mean)
        flat = self._Z.reshape(-1, D)
        self.factor = np.linalg.cholesky(belief.widened(belief.drift) + flat.T @ flat)
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

    def information(
        self, step: int, columns: Array | slice = slice(None), first: int = 0
    ) -> tuple[Array, Array]:
        """(s, k, k) G and (s, k) b for starts at every `step` rows from the row `first` on."""
        Z, S, r = self._Z[first:], self._S[first:, :, columns], self._r[first:]
        D, K, starts = Z.shape[2], S.shape[2], len(S) // step
        G, b = np.empty((starts, K, K)), np.empty((starts, K))
        B, C, own = np.zeros((D, K)), np.zeros((K, K)), np.zeros(K)
        for k in reversed(range(starts)):  # what a later start has, an earlier one has too
            rows = slice(k * step, (k + 1) * step)
            Zk, Sk = Z[rows].reshape(-1, D), S[rows].reshape(-1, K)
            B += Zk.T @ Sk
            C += Sk.T @ Sk
            own += r[rows].ravel() @ Sk
            X = self._inverse @ B
            G[k], b[k] = C - X.T @ X, own - self._pull @ X
        return G, b

    def leftover(self, candidate: Signature, a: Array, first: int) -> Array:
        """(rows, n) residual that stays when the candidate acts with coefficients a."""
        added = self.rows.S[:, :, candidate.columns] @ a
        added[:first] = 0.0
        root = np.sqrt(self.weight)
        D = self._Z.shape[2]
        right = self._Z.reshape(-1, D).T @ (self._r - added * root).ravel()
        shift = self._inverse.T @ (self._inverse @ right)
        return np.asarray(self.residual - added - self.rows.Z @ shift)


class Level:
    """Running noise level of each joint: of rows, and of sums over 0.4 s, which are what counts.

    Noise of arms is coloured: a sum of rows varies more than that many independent rows would.

    Args:
        variance: (n,) first guess of a row's, (N m)²; inflation: first guess of how many times
            more a sum of rows varies.
    """

    def __init__(self, variance: Array, inflation: float) -> None:
        self.row = variance.copy()
        self.long = inflation * variance
        self._rows, self._sums = START_SUMS * 2 * ROWS_PER_GROUP, START_SUMS
        self._half: tuple[Array, Array] | None = None

    def look(self, residual: Array, unsure: Array) -> None:
        """Take the residual (r, n) of one group; the more `unsure` a row is, the less it counts."""
        share = self.share(unsure)
        for r, counts in zip(residual**2, share, strict=True):
            self._rows = min(self._rows + 1.0, LEVEL_ROWS)
            self.row += counts * (np.minimum(r, CLIP * self.row) - self.row) / self._rows
        half = residual.sum(axis=0), share.min(axis=0)
        if self._half is None:
            self._half = half
            return
        power = (self._half[0] + half[0]) ** 2 / (2 * len(residual))
        counts = np.minimum(self._half[1], half[1])
        self._half = None
        self._sums = min(self._sums + 1.0, LEVEL_SUMS)
        self.long += counts * (np.minimum(power, CLIP * self.long) - self.long) / self._sums

    def share(self, unsure: Array) -> Array:
        """(r, n) of a row's residual squared that noise may be, the rest being `unsure`."""
        return np.asarray(self.row / (self.row + unsure))

    def weight(self, unsure: Array) -> Array:
        """(r, n) information that each row has, 1/(N m)²."""
        return np.asarray(1.0 / (np.maximum(self.long, 1.2 * self.row) + unsure))
