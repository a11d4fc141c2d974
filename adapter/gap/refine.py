"""The last fit: names stay, and each row counts as far as the effects' equations go.

The search weighs rows by themselves. Where noise is coloured that is not enough: what a row gets
wrong (a joint that sticks, a turn) stays in the six behind it once it is whitened, pulls at
friction, and passes for noise. Here it has a variance of its own beside the noise, row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular, toeplitz
from scipy.ndimage import maximum_filter1d
from scipy.signal import lfilter

from adapter.effects.base import TorqueEffect
from adapter.effects.by_joint import SMOOTHING_DQ
from adapter.gap.candidates import is_finer
from adapter.gap.evidence import LEAST_NM, ORDER, Carried, Noise, noise_of
from adapter.gap.fit import Fit, refitted, shaped, unsure
from adapter.gap.search import Found, weak, worst
from adapter.model.spatial import Array

ROUNDS, NOISE_ROUNDS = 2, 3
SPAN = 512  # rows, 20 s: noise of one span does not know that of the next
MEMORY = 4 * SPAN  # rows after which noise has forgotten where it came from
NOT_COUNTED_NM = 1e3
LARGE = 3.0  # times the noise: a doubt that would pass for noise
NEAR = 5  # rows around one, in which a doubt concerns it


@dataclass(frozen=True, eq=False)
class DoubtedNoise(Noise):
    """Coloured noise, and beside it an error of the model that is known row by row.

    Attributes:
        doubt: (k, n) standard deviation of that error, N m.
        seams: rows at which stretches begin.
    """

    doubt: Array
    seams: tuple[int, ...] = (0,)

    @classmethod
    def of(cls, noise: Noise, doubt: Array, seams: tuple[int, ...] = (0,)) -> DoubtedNoise:
        """Doubt beside a noise."""
        return cls(noise.ar, noise.sigma, noise.level, doubt, seams)

    @cached_property
    def _spans(self) -> list[tuple[int, slice, Array, Array]]:
        """Of each joint and span: joint, rows, root of the covariance, that of the noise alone."""
        out, ends = [], pairwise([*self.seams, len(self.doubt)])
        rows_of = [
            slice(a, min(a + SPAN, end)) for begin, end in ends for a in range(begin, end, SPAN)
        ]
        for j, (ar, sigma) in enumerate(zip(self.ar, self.sigma, strict=True)):
            answer = lfilter([sigma], np.append(1.0, -ar), np.eye(1, MEMORY)[0])
            known = np.correlate(answer, answer, "full")[MEMORY - 1 : MEMORY - 1 + SPAN]
            for rows in rows_of:
                own = self.doubt[rows, j]
                noise = toeplitz(known[: len(own)])
                out.append((j, rows, cholesky(noise + np.diag(own**2), lower=True), noise))
        return out

    def whiten(self, x: Array) -> Array:
        """Signals (..., k, n) made white and of unit variance, (..., k - p, n)."""
        out = np.empty(x.shape)
        for j, rows, root, _ in self._spans:
            part = x[..., rows, j]
            white = solve_triangular(root, part.reshape(-1, len(root)).T, lower=True)
            out[..., rows, j] = white.T.reshape(part.shape)
        return out[..., ORDER:, :]

    def smooth(self, residual: Array) -> Array:
        """The noise in a residual (k, n), as far as it can be told from the doubted error."""
        out = np.empty_like(residual)
        for j, rows, root, noise in self._spans:
            out[rows, j] = noise @ cho_solve((root, True), residual[rows, j])
        return out


def refined(found: Found) -> Found:
    """The same with coefficients and settings at which doubtful rows do not pull.

    What these rows alone spoke for is left out.

    Returns:
        What was found itself where nothing is in doubt, or where physics does not allow what comes
        out.
    """
    fit, standings = found.fit, list(found.standings)
    counted = fit.weights or tuple(np.ones_like(r.tau) for r in fit.recordings)
    if not any(e.candidate.effect.inexact for e in fit.named):
        return found
    while True:
        fit, carried = _refitted(fit, counted)
        values = weak(fit, carried)
        bad = worst(fit, values)
        if bad is None:
            kept = replace(found, fit=fit, carried=carried, standings=tuple(standings))
            return replace(kept, weak=frozenset(values))
        fit = fit.without(bad)
        del standings[bad]


def _refitted(fit: Fit, counted: Sequence[Array]) -> tuple[Fit, Carried]:
    """A fit under doubted noise; `counted` (k, n) by recording is zero where nothing is known."""
    noise: Sequence[Noise] = fit.own_noise()
    for _ in range(ROUNDS):
        doubts = [doubt_of(fit, i, counted[i]) for i in range(len(fit.recordings))]
        seams = [own.seams for own in fit.recordings]
        for _ in range(NOISE_ROUNDS):
            noise = list(map(_noise, noise, doubts, fit.model.residuals(), seams))
        fit = replace(fit, noise=tuple(map(DoubtedNoise.of, noise, doubts, seams)), weights=())
        fit = refitted(fit)[0]
        for k, e in enumerate(fit.named):
            # what was assumed beside a simpler form by name is what that leaves: with a shape of
            # its own it would take that one's place
            rest = e.assumed and any(is_finer(e.candidate, x.candidate) for x in fit.named)
            if not rest:
                fit = shaped(fit, k)
    return refitted(fit)


def _noise(before: Noise, doubt: Array, residual: Array, seams: tuple[int, ...]) -> Noise:
    """Noise of a residual (k, n), where doubt is large as its neighbours have it."""
    large = np.where(doubt > LARGE * before.level, doubt, 0.0)
    smooth = DoubtedNoise.of(before, large, seams).smooth(residual)
    return noise_of(smooth, LEAST_NM, seams=seams)


def doubt_of(fit: Fit, recording: int, counted: Array) -> Array:
    """(k, n) N m by which the named effects may be wrong; `counted` (k, n) is zero where all is."""
    own, at = fit.recordings[recording], fit.model.stages(recording)
    square = np.where(counted > 0.0, 0.0, NOT_COUNTED_NM**2)
    for k, e in enumerate(fit.named):
        effect, joint = e.candidate.effect, e.candidate.joint
        if not effect.inexact or e.recording not in (None, recording):
            continue
        square += unsure(fit.model, recording, k) ** 2
        if isinstance(effect, TorqueEffect):  # a speed may be off by what counts as rest
            fast, slow = (
                effect.torque(replace(at.links, dq=at.links.dq + off), at.rigid, joint, e.values)
                for off in (SMOOTHING_DQ, -SMOOTHING_DQ)
            )
            change = np.abs(own.low(0.5 * (fast - slow) * e.gate(at.links.t)))
            square += maximum_filter1d(change, NEAR, axis=0) ** 2
    return np.asarray(np.sqrt(square).reshape(own.tau.shape))
