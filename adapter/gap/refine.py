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
from adapter.gap.fit import Fit, Named, refitted, shaped, unsure
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
        out = []
        for j, (ar, sigma) in enumerate(zip(self.ar, self.sigma, strict=True)):
            answer = lfilter([sigma], np.append(1.0, -ar), np.eye(1, MEMORY)[0])
            known = np.correlate(answer, answer, "full")[MEMORY - 1 : MEMORY - 1 + SPAN]
            for rows in self._rows:
                own = self.doubt[rows, j]
                noise = toeplitz(known[: len(own)])
                out.append((j, rows, cholesky(noise + np.diag(own**2), lower=True), noise))
        return out

    @property
    def _rows(self) -> list[slice]:
        ends = pairwise([*self.seams, len(self.doubt)])
        return [
            slice(a, min(a + SPAN, end)) for begin, end in ends for a in range(begin, end, SPAN)
        ]

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
        for k in range(len(fit.named)):
            if not _is_rest(fit, k):
                fit = shaped(fit, k)
    return refitted(fit)


def _is_rest(fit: Fit, k: int) -> bool:
    """Whether it was assumed, and its joint has a simpler form by name: it is what that leaves.

    With a shape of its own it would take that one's place.
    """
    e = fit.named[k]
    return e.assumed and any(is_finer(e.candidate, other.candidate) for other in fit.named)


def _noise(before: Noise, doubt: Array, residual: Array, seams: tuple[int, ...]) -> Noise:
    """Noise of a residual (k, n), where doubt is large as its neighbours have it."""
    large = np.where(doubt > LARGE * before.level, doubt, 0.0)
    smooth = DoubtedNoise.of(before, large, seams).smooth(residual)
    return noise_of(smooth, LEAST_NM, seams=seams)


def doubt_of(fit: Fit, recording: int, counted: Array) -> Array:
    """(k, n) N m by which the named effects may be wrong; `counted` (k, n) is zero where all is."""
    own = fit.recordings[recording]
    square = np.where(counted > 0.0, 0.0, NOT_COUNTED_NM**2)
    for k, e in enumerate(fit.named):
        if e.candidate.effect.inexact and e.recording in (None, recording):
            square += unsure(fit.model, recording, k) ** 2
            square += _by_speed(fit, e, recording) ** 2
    return np.asarray(np.sqrt(square).reshape(own.tau.shape))


def _by_speed(fit: Fit, e: Named, recording: int) -> Array:
    """(k, n) N m by which an effect changes where a speed is off by what counts as rest."""
    effect, at, own = e.candidate.effect, fit.model.stages(recording), fit.recordings[recording]
    if not isinstance(effect, TorqueEffect):
        return np.zeros_like(own.tau)
    fast, slow = (
        effect.torque(
            replace(at.links, dq=at.links.dq + off), at.rigid, e.candidate.joint, e.values
        )
        for off in (SMOOTHING_DQ, -SMOOTHING_DQ)
    )
    change = np.abs(own.low(0.5 * (fast - slow) * e.gate(at.links.t)))
    return np.asarray(maximum_filter1d(change, NEAR, axis=0))
