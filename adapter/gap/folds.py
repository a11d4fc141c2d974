"""Blocks of time in turn, each held out by one fold: what a fit has not seen.

A block is held out as a whole, since neighbouring instants know each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.effects.catalogue import LATENESS
from adapter.gap.evidence import Carried, Moments, Normal
from adapter.gap.fit import Fit, beside
from adapter.model.spatial import Array

FOLDS = 4
FOLD_S, SHORTEST_S = 2.0, 0.2  # of a block
LARGEST_SHARE = 0.125  # of a recording: what is left must tell what the model tells


def block_s(fit: Fit) -> float:
    """Length of the blocks that are held out: what lasts but a second is in several of them."""
    spans = [e.interval_s[1] - e.interval_s[0] for e in fit.named]
    spans = [x / (2 * FOLDS) for x in spans]
    spans += [LARGEST_SHARE * float(np.ptp(own.t)) for own in fit.recordings]
    return float(max(min([FOLD_S, *spans]), SHORTEST_S))


def holds_out(fit: Fit) -> bool:
    """Whether its blocks leave enough of each recording to fit."""
    spans = [float(np.ptp(own.t)) for own in fit.recordings]
    return block_s(fit) <= LARGEST_SHARE * min(spans) * (1.0 + 1e-9)


def fold_of(t: Array, block: float) -> np.ndarray:
    """(m,) fold of each instant: blocks of time in turn."""
    return np.asarray((t // block).astype(int) % FOLDS)


def fold_rows(fit: Fit) -> np.ndarray:
    """(r,) fold of each white row."""
    rows = []
    for own in fit.recordings:
        rows.append(np.repeat(fold_of(own.t, block_s(fit)), fit.n))
    return np.concatenate(rows)


@dataclass(frozen=True, eq=False)
class Folds:
    """Products of what a fit carries, in each fold apart.

    Attributes:
        G: (FOLDS, c, c) of the signatures with one another; g: (FOLDS, c) with the data.
        power: (FOLDS,) of the data with themselves.
        prior_std: (c,) of the coefficients.
    """

    G: Array
    g: Array
    power: Array
    prior_std: Array

    @classmethod
    def of(cls, fit: Fit, carried: Carried | Moments) -> Folds:
        """What is known of a fit's coefficients, by folds."""
        if isinstance(carried, Moments):
            return cls(*carried.folds, carried.prior_std)
        fold = fold_rows(fit)
        parts = [(carried.N[:, fold == f], carried.data[fold == f]) for f in range(FOLDS)]
        return cls(
            np.array([N @ N.T for N, _ in parts]),
            np.array([N @ data for N, data in parts]),
            np.array([data @ data for _, data in parts]),
            carried.prior_std,
        )

    def known(self, at: np.ndarray | slice = slice(None)) -> list[Normal]:
        """Some coefficients, alone, once per fold, each without that fold's blocks of time.

        Names, dates and the noise are those that all data gave; what is fitted is refitted.
        """
        G, g, std = self.G[:, at][:, :, at], self.g[:, at], self.prior_std[at]
        return [Normal(G.sum(0) - G[f], g.sum(0) - g[f], std) for f in range(FOLDS)]

    def left(self, at: np.ndarray) -> float:
        """Squared distance of each fold's data from what the others foretell, over all folds."""
        total = 0.0
        for f, known in enumerate(self.known(at)):
            x, G, g = known.x, self.G[f][np.ix_(at, at)], self.g[f, at]
            total += float(self.power[f] - 2.0 * (x @ g) + x @ G @ x)
        return total


def pays_held_out(fit: Fit, folds: Folds, k: int) -> bool:
    """Whether the k-th named effect predicts unseen blocks; a tie is left to the evidence."""
    own, rest = beside(fit, k)
    if fit.named[k].candidate.effect is LATENESS:  # the carried error would stand for it
        rest = rest[rest != fit.dtheta.size]
    return folds.left(rest) - folds.left(np.concatenate([rest, own])) > -2.0  # or a tie
