"""Moments of a whole long recording: what was found in some stretches is weighed on all.

Names, dates, nonlinear settings and the noise are those of the stretches. Signatures and
residuals are computed piece by piece, their products are kept, and the pieces forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adapter.gap.evidence import Moments
from adapter.gap.fit import BLOCK, Fit
from adapter.gap.folds import FOLDS, block_s, fold_of
from adapter.gap.long_recording import LongRecording
from adapter.gap.search import Found


def weighed(found: Found, whole: LongRecording) -> Found:
    """What was found in some stretches of a recording, fitted to all of it."""
    under = found.under or found.fit
    for _ in range(2):  # of Gauss and Newton where the model is not linear
        moments = moments_of(under, whole)
        step = np.abs(moments.x - under.coefficients) / moments.std()
        under = under.at(moments.x)
        if under.is_linear or step.max() < 0.3:  # standard deviations: no further step is needed
            break
    fit, known = found.fit.at(moments.x), None
    if found.known is not None:
        known = moments.under(fit.prior_std)
        if not found.fit.dtheta.any():  # left as documented: the prior is no finding
            fit = replace(fit, model=replace(fit.model, dtheta=np.zeros_like(fit.dtheta)))
    return replace(found, fit=fit, carried=moments, known=known)


def moments_of(fit: Fit, whole: LongRecording) -> Moments:
    """Moments of a recording about a fit to some of its stretches.

    Args:
        fit: of one recording, its noise being that of all.
    """
    c, n = len(fit.coefficients), fit.n
    G, g, power = np.zeros((FOLDS, c, c)), np.zeros((FOLDS, c)), np.zeros(FOLDS)
    seconds, block = np.zeros((c, c)), block_s(fit)
    for part in pieces_of(fit, whole):
        N, left = part.whiten([part.model.signatures(0)]), part.whiten(part.model.residuals())
        data = left + fit.coefficients @ N
        fold = np.repeat(fold_of(part.recordings[0].t, block), n)
        for f in range(FOLDS):
            own = N[:, fold == f]
            G[f] += own @ own.T
            g[f] += own @ data[fold == f]
            power[f] += float(data[fold == f] @ data[fold == f])
        sums = np.add.reduceat(N * left, np.arange(0, len(left), BLOCK * n), axis=1)
        seconds += sums @ sums.T
    return Moments((G, g, power), fit.prior_std, seconds)


def pieces_of(fit: Fit, whole: LongRecording) -> Iterator[Fit]:
    """A fit on each piece of a recording, under its noise."""
    for own in whole.pieces(fit.recordings[0]):
        model = replace(fit.model, recordings=(own,))
        piece = replace(fit, model=model, doubts=())
        yield piece.with_noise(fit.noise) if fit.doubts else piece
