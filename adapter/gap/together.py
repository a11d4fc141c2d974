"""Several recordings of one arm in one least squares: what is common to all, and each one's own.

Each recording's own coefficients are eliminated from its own products; what is left of these is
about the common ones alone and adds up (a Schur complement, recording by recording). So the work
grows with the number of recordings, and not with its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from adapter.gap.evidence import ORDER, Carried
from adapter.gap.fit import Fit
from adapter.model.spatial import Array

BLOCK = 25  # samples at 25 Hz: errors of the model last so long, noise does not


@dataclass(frozen=True, eq=False)
class Part:
    """One recording's share.

    Attributes:
        known: of all its coefficients; own: (o,) places of its own; common: (c,) of the others.
        G: (c, c) what it knows of the common ones, its own eliminated; g: (c,) with its data.
        free: (o, o) covariance of its own where the common ones are known.
        cross: (o, c) its own with the common ones.
        rows: of the white signatures that a second has.
    """

    known: Carried
    own: np.ndarray
    common: np.ndarray
    G: Array
    g: Array
    free: Array
    cross: Array
    rows: int

    @classmethod
    def of(cls, fit: Fit, own: np.ndarray) -> Part:
        """From the fit of one recording."""
        known = fit.carried()
        common = np.delete(np.arange(len(known.g)), own)
        A = known.G[np.ix_(own, own)] + np.diag(known.prior_std[own] ** -2.0)
        free = cho_solve(cho_factor(A, lower=True), np.eye(len(own)))
        cross = known.G[np.ix_(own, common)]
        G = known.G[np.ix_(common, common)] - cross.T @ free @ cross
        g = known.g[common] - cross.T @ free @ known.g[own]
        return cls(known, own, common, G, g, free, cross, BLOCK * fit.n)

    def own_at(self, x: Array) -> Array:
        """(o,) its own coefficients where the common ones are x (c,)."""
        return np.asarray(self.free @ (self.known.g[self.own] - self.cross @ x))

    def all_at(self, x: Array) -> Array:
        """All its coefficients, in its order, where the common ones are x (c,)."""
        out = np.empty(len(self.known.g))
        out[self.common], out[self.own] = x, self.own_at(x)
        return out

    def scores(self, x: Array) -> tuple[Array, Array]:
        """Of its seconds, (s, c) what each adds to `g - G x`, and (s, o) to its own gradient."""
        left = self.known.data - self.all_at(x) @ self.known.N
        cuts = np.arange(0, len(left), self.rows)
        sums = np.add.reduceat(self.known.N * left, cuts, axis=1).T
        own = sums[:, self.own]
        return sums[:, self.common] - own @ self.free @ self.cross, own


class Together:
    """Recordings in one least squares.

    Args:
        parts: theirs, with the same common coefficients in the same order.

    Attributes:
        x: (c,) the common coefficients; covariance: (c, c) of them, no smaller than what seconds
            of the recordings disagree by (see `fit.honest_covariance`).
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = parts
        std = parts[0].known.prior_std[parts[0].common]
        self.G = np.sum([part.G for part in parts], axis=0) + np.diag(std**-2.0)
        self.g = np.sum([part.g for part in parts], axis=0)
        self.plain = np.linalg.inv(self.G)
        self.x = self.plain @ self.g
        self._scores = [part.scores(self.x) for part in parts]
        self.spread = [common.T @ common for common, _ in self._scores]
        self._all = np.sum(self.spread, axis=0) + np.diag(std**-2.0)
        self.covariance = widened(self.plain, self.plain @ self._all @ self.plain)

    def own(self, i: int) -> tuple[Array, Array]:
        """(o,) the i-th recording's own coefficients, and (o, o) their covariance."""
        part, (common, mine) = self.parts[i], self._scores[i]
        H = part.free @ part.cross @ self.plain
        plain = part.free + H @ part.cross.T @ part.free
        off = mine @ part.free - common @ H.T
        prior = part.known.prior_std[part.own]
        robust = off.T @ off + H @ (self._all - self.spread[i]) @ H.T
        robust += part.free @ np.diag(prior**-2.0) @ part.free
        return part.own_at(self.x), widened(plain, robust)


def widened(plain: Array, robust: Array) -> Array:
    """A covariance whose standard deviations are those of another one where these are larger."""
    wider = np.sqrt(np.maximum(np.diagonal(robust) / np.diagonal(plain), 1.0))
    return np.asarray(plain * np.outer(wider, wider))
