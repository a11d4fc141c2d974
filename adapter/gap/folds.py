"""Blocks of time in turn, each held out by one fold: what a fit has not seen.

A block is held out as a whole, since neighbouring instants know each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from adapter.effects.catalogue import LATENESS
from adapter.gap.evidence import Carried, Moments, Normal
from adapter.gap.fit import Fit, beside
from adapter.model.spatial import Array

FOLDS = 4
FOLD_S, SHORTEST_S = 2.0, 0.2  # of a block
# Of a recording: what is left must tell what the model tells. Of an effect's evidence: what
# blocks that are not seen must confirm.
LARGEST_SHARE, FORETOLD = 0.125, 0.5


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
        prior_std: (c,) of the coefficients.
    """

    G: Array
    g: Array
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
            carried.prior_std,
        )

    @cached_property
    def every(self) -> Normal:
        """Coefficients by all folds."""
        return Normal(self.G.sum(0), self.g.sum(0), self.prior_std)

    @cached_property
    def known(self) -> list[Normal]:
        """Coefficients once per fold, each without that fold's blocks of time.

        Names, dates and the noise are those that all data gave; what is fitted is refitted.
        """
        G, g = self.every.G - self.G, self.every.g - self.g
        return [Normal(*both, self.prior_std) for both in zip(G, g, strict=True)]


def pays_held_out(fit: Fit, folds: Folds, k: int) -> bool:
    """Whether the k-th named effect foretells unseen blocks, fold by fold.

    By likelihood: a fold's, given the others, is that of all over theirs. What they leave open is
    doubt then, and no error; it is much where a joint moves in one fold alone. All folds together
    foretell as much as the effect is worth where it is the same in each.
    """
    own, rest = beside(fit, k)
    if fit.named[k].candidate.effect is LATENESS:  # the carried error would stand for it
        rest = rest[rest != fit.dtheta.size]
    every, *others = (x.worth(own, rest).log_evidence for x in (folds.every, *folds.known))
    return FOLDS * every - sum(others) > FORETOLD * every
