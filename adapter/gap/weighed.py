"""Moments of a whole long recording: what was found in some stretches is weighed on all.

Names, dates, nonlinear settings and the noise are those of the stretches. Signatures and
residuals are computed piece by piece, their products are kept, and the pieces forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import eigh, solve

from adapter.gap.evidence import Moments
from adapter.gap.fit import BLOCK, Fit
from adapter.gap.folds import FOLDS, block_s, fold_of
from adapter.gap.long_recording import LongRecording
from adapter.gap.search import Found
from adapter.model.spatial import Array

STEPS = 2  # of Gauss and Newton where the model is not linear
NEAR = 0.3  # standard deviations: a step that needs no further one


def weighed(found: Found, whole: LongRecording) -> Found:
    """What was found in some stretches of a recording, fitted to all of it."""
    under = found.under or found.fit
    for _ in range(STEPS):
        moments = moments_of(under, whole)
        step = np.abs(moments.x - under.coefficients) / moments.std()
        under = under.at(moments.x)
        if under.is_linear or step.max() < NEAR:
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
    starts = fit.dtheta.size + 1 + np.arange(fit.model.start_nm.size)
    rest = np.delete(np.arange(c), starts)
    for part in pieces_of(fit, whole):
        N, data = _without_starts(part)
        data = data + fit.coefficients[rest] @ N
        fold = np.repeat(fold_of(part.recordings[0].t, block), n)
        for f in range(FOLDS):
            own = N[:, fold == f]
            G[f][np.ix_(rest, rest)] += own @ own.T
            g[f, rest] += own @ data[fold == f]
            power[f] += float(data[fold == f] @ data[fold == f])
        left = data - fit.coefficients[rest] @ N
        sums = np.add.reduceat(N * left, np.arange(0, len(left), BLOCK * n), axis=1)
        seconds[np.ix_(rest, rest)] += sums @ sums.T
    _held_at_starts(fit, (G, g), starts, rest)
    return Moments((G, g, power), fit.prior_std, seconds)


def pieces_of(fit: Fit, whole: LongRecording) -> Iterator[Fit]:
    """A fit on each piece of a recording, under its noise."""
    for own in whole.pieces(fit.recordings[0]):
        model = replace(fit.model, recordings=(own,), start_nm=np.zeros((1, fit.n)))
        piece = replace(fit, model=model, weights=())
        yield piece.with_noise(fit.noise) if fit.weights else piece


def _without_starts(piece: Fit) -> tuple[Array, Array]:
    """(c, r) white signatures and (r,) residual once what joints held before has had its share.

    Rows are changed so that their products are the Schur complement of each piece's own starts.
    """
    size, n = piece.dtheta.size + 1, piece.n
    N = piece.whiten([piece.model.signatures(0)])
    data = piece.whiten(piece.model.residuals())
    A = N[size : size + n] * piece.prior_std[size : size + n, None]
    N = np.delete(N, np.s_[size : size + n], axis=0)
    share, axes = eigh(A @ A.T)
    share = np.maximum(share, 1e-12)
    B = ((1.0 - (1.0 + share) ** -0.5) / share) * axes @ axes.T @ A
    return N - (N @ A.T) @ B, data - (data @ A.T) @ B


def _held_at_starts(
    fit: Fit, moments: tuple[Array, Array], starts: np.ndarray, rest: np.ndarray
) -> None:
    """Put what joints held as the stretches began into moments (in place), beside all else.

    Pieces have had theirs eliminated; the stretches are what curves and scores are of.
    """
    G, g = moments
    x = solve(
        G.sum(axis=0)[np.ix_(rest, rest)] + np.diag(fit.prior_std[rest] ** -2.0),
        g.sum(axis=0)[rest],
        assume_a="pos",
    )
    own = fit.carried()
    A = own.G[np.ix_(starts, starts)]
    held = solve(
        A + np.diag(fit.prior_std[starts] ** -2.0),
        own.g[starts] - own.G[np.ix_(starts, rest)] @ x,
        assume_a="pos",
    )
    right = A @ held + held / fit.prior_std[starts] ** 2
    for f in range(FOLDS):  # each may be left out
        G[f][np.ix_(starts, starts)] += A / FOLDS
        g[f, starts] += right / FOLDS
