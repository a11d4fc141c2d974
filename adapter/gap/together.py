"""Several recordings of one arm in one least squares: what is common to all, and each one's own.

Each recording's own coefficients are eliminated from its own products; what is left of these is
about the common ones alone and adds up (a Schur complement, recording by recording). So the work
grows with the number of recordings, and not with its square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from adapter.gap.evidence import Carried
from adapter.gap.fit import BLOCK, Fit
from adapter.model.spatial import Array


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
        prior_std: (c,) of the common coefficients.

    Attributes:
        x: (c,) the common coefficients; covariance: (c, c) of them.
    """

    def __init__(self, parts: Sequence[Part], prior_std: Array) -> None:
        self.parts, self.prior = parts, np.diag(prior_std**-2.0)
        self.G = np.sum([part.G for part in parts], axis=0) + self.prior
        self.g = np.sum([part.g for part in parts], axis=0)
        self.covariance = np.linalg.inv(self.G)
        self.x = self.covariance @ self.g

    @cached_property
    def scores(self) -> list[tuple[Array, Array]]:
        """Of each part, see there."""
        return [part.scores(self.x) for part in self.parts]

    @cached_property
    def spread(self) -> Array:
        """(c, c) by how much the seconds of all recordings disagree, and the prior with them."""
        return np.asarray(np.sum([x.T @ x for x, _ in self.scores], axis=0) + self.prior)

    def own(self, i: int) -> tuple[Array, Array]:
        """(o,) the i-th recording's own coefficients, and (o, o) their covariance.

        By the noise, and no less than by what seconds disagree: what a model gets wrong does not
        average out as noise does (White 1980, by clusters).
        """
        part, (common, mine) = self.parts[i], self.scores[i]
        H = part.free @ part.cross @ self.covariance
        plain = part.free + H @ part.cross.T @ part.free
        off = mine @ part.free - common @ H.T
        prior = np.diag(part.known.prior_std[part.own] ** -2.0)
        robust = off.T @ off + H @ (self.spread - common.T @ common) @ H.T
        robust += part.free @ prior @ part.free
        wider = np.sqrt(np.maximum(np.diagonal(robust) / np.diagonal(plain), 1.0))
        return part.own_at(self.x), plain * np.outer(wider, wider)

    def without(self, i: int) -> tuple[Array, Array]:
        """(c,) the common coefficients by all recordings but the i-th, and (c, c) covariance."""
        part = self.parts[i]
        covariance = np.linalg.inv(self.G - part.G)
        return covariance @ (self.g - part.g), covariance
