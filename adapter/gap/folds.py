"""Blocks of time in turn, each held out by one fold: what a fit has not seen.

A block is held out as a whole, since neighbouring instants know each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.effects.catalogue import LATENESS
from adapter.gap.evidence import Carried, Moments, Normal
from adapter.gap.fit import Fit, beside, place_of
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


def without_each(fit: Fit, carried: Carried | Moments) -> list[Normal]:
    """What is known of a fit's coefficients without the blocks of each fold in turn.

    Names, dates and the noise are those that all data gave; what is fitted is refitted.
    """
    if isinstance(carried, Moments):
        products = list(zip(*carried.folds, strict=True))
    else:
        fold = fold_rows(fit)
        parts = [(carried.N[:, fold == f], carried.data[fold == f]) for f in range(FOLDS)]
        products = [(N @ N.T, N @ data) for N, data in parts]
    return [Normal(carried.G - G, carried.g - g, carried.prior_std) for G, g in products]


def pays_held_out(fit: Fit, every: Normal, others: Sequence[Normal], k: int) -> bool:
    """Whether the k-th named effect foretells unseen blocks, fold by fold.

    By likelihood: a fold's, given the others, is that of all over theirs. What they leave open is
    doubt then, and no error; it is much where a joint moves in one fold alone. All folds together
    foretell as much as the effect is worth where it is the same in each.

    Args:
        every: what is known of the fit's coefficients; others: see `without_each`.
    """
    own, rest = beside(fit, k)
    one = fit.named[k].candidate
    alike = (i for i, e in enumerate(fit.named) if e.assumed and e.candidate.key == one.key)
    small = [fit.dtheta.size] if one.effect is LATENESS else []
    small += [place for i in alike for place in place_of(fit, i)]
    rest = rest[~np.isin(rest, small)]  # what any arm has of its kind would stand for it
    value, *parts = (x.worth(own, rest).log_evidence for x in (every, *others))
    return FOLDS * value - sum(parts) > FORETOLD * value
