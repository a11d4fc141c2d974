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

from adapter.gap.evidence import score, scores
from adapter.gap.monitor_signatures import Signature
from adapter.model.spatial import Array
from adapter.signals.records import StateLayout, stamp_of

BLOCK_NS = 40_000_000  # states averaged to one row: 25 rows a second
HOLE_NS = 20_000_000  # a longer hole between two states ends a block without a row
ROWS_PER_GROUP = 5
CLIP = 9.0  # times its level: what a row says at most about the level
LEVEL_ROWS, LEVEL_SUMS = 250.0, 40.0  # rows and sums that the level is averaged over
START_SUMS = 5.0  # that the first guess of the level counts
LEAST_INFLATION = 1.2


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
class Window:
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

    def __init__(self, rows: Window, belief: Belief) -> None:
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

    def leftover(self, candidate: Signature, a: Array, first: int) -> Array:
        """(rows, n) residual that stays when the candidate acts with coefficients a."""
        added = self.rows.S[:, :, candidate.columns] @ a
        added[:first] = 0.0
        root = np.sqrt(self.rows.weight)
        D = self._Z.shape[2]
        right = self._Z.reshape(-1, D).T @ (self._r - added * root).ravel()
        shift = self._inverse.T @ (self._inverse @ right)
        return np.asarray(self.residual - added - self.rows.Z @ shift)


def log_evidence(signature: Signature, G: Array, b: Array) -> Array:
    """(s,) L of a signature from its own G (s, k, k) and b (s, k)."""
    return scores(G, b, signature.std)[0] + signature.log_odds


def coefficients(signature: Signature, G: Array, b: Array) -> Array:
    """(k,) most likely coefficients from G (k, k) and b (k,)."""
    return score(G, b, signature.std).x


class Blocks:
    """Averages states; cheap for each of them.

    Args:
        n: joints.
    """

    def __init__(self, n: int) -> None:
        at = StateLayout(n)
        self._n, self._signals = n, slice(at.q.start, at.tau.stop)
        self._sum = np.zeros(4 * n)
        self._count, self._begin_ns, self._last_ns, self._stamps = 0, 0, 0, 0

    def add(self, table: Array) -> list[tuple[float, Array]]:
        """Take states (m, size); rows (s, (4 n,)) of the blocks that they complete."""
        if len(table) == 1:
            done = self._add_one(table[0])
            return [] if done is None else [done]
        return [row for state in table if (row := self._add_one(state)) is not None]

    def _add_one(self, state: Array) -> tuple[float, Array] | None:
        stamp = stamp_of(state)
        done = None
        if self._count and not 0 < stamp - self._last_ns <= HOLE_NS:
            self._count = 0
        elif self._count and stamp - self._begin_ns >= BLOCK_NS:
            middle = self._begin_ns + self._stamps / self._count
            done = 1e-9 * middle, self._sum / self._count
            self._count = 0
        if not self._count:
            self._sum[:] = 0.0
            self._begin_ns, self._stamps = stamp, 0
        self._sum += state[self._signals]
        self._stamps += stamp - self._begin_ns
        self._count += 1
        self._last_ns = stamp
        return done


@dataclass(eq=False)
class Group:
    """`ROWS_PER_GROUP` rows with all that is computed of them once.

    Attributes:
        t: (r,) s; Z: (r, n, D0) regressor and the learned effects' columns; S: (r, n, K)
            signatures; tau: (r, n).
    """

    t: Array
    Z: Array
    S: Array
    tau: Array


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
        self._half: Array | None = None

    def look(self, residual: Array) -> None:
        """Take the residual (r, n) of one group."""
        for r in residual**2:
            self._rows = min(self._rows + 1.0, LEVEL_ROWS)
            self.row += (np.minimum(r, CLIP * self.row) - self.row) / self._rows
        if self._half is None:
            self._half = residual.sum(axis=0)
            return
        count = 2 * len(residual)
        power = (self._half + residual.sum(axis=0)) ** 2 / count
        self._half = None
        self._sums = min(self._sums + 1.0, LEVEL_SUMS)
        self.long += (np.minimum(power, CLIP * self.long) - self.long) / self._sums

    @property
    def weight(self) -> Array:
        """(n,) information that one row has, 1/(N m)²."""
        return np.asarray(1.0 / np.maximum(self.long, LEAST_INFLATION * self.row))
