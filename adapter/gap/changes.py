"""When something changed in a long recording: looked for in all of it, before the search.

A plain model (what any arm has, fitted to some stretches) leaves a residual. Of every window of
some seconds its products with what may change at once are kept: a body at the hand, and offset
and friction of each joint. A change at some time shows as a difference between all windows before
it and all behind it; something that comes and goes, as a window that is much louder than usual.
The search then gets rows around these times, and decides what it was and when.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.effects.base import Effect, LinearEffect
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import CATALOGUE, HELD
from adapter.gap.evidence import ORDER
from adapter.gap.fit import Fit
from adapter.gap.long_recording import STRETCH_S, LongRecording, Span
from adapter.gap.weighed import pieces_of
from adapter.model.spatial import Array

WINDOW_S, MOST_WINDOWS = 2.0, 2048
CHANGES, LOUD = 3, 2  # stretches that are added at most: around changes, where it is loud
LEAST_CHI2 = 200.0  # of a change, times what windows scatter more than noise does
LOUDER = 4.0  # times the usual power
MARGIN = 2  # windows at either end


@dataclass(frozen=True, eq=False)
class Windows:
    """What a model leaves of a recording, by windows of time.

    Attributes:
        every_s: from one to the next.
        G: (w, c, c) products of white signatures of changes with one another; g: (w, c) with the
            residual; power: (w,) of the residual; rows: (w,) of them.
        prior_std: (c,) of the signatures' coefficients.
    """

    every_s: float
    G: Array
    g: Array
    power: Array
    rows: Array
    prior_std: Array

    @classmethod
    def of(cls, fit: Fit, whole: LongRecording) -> Windows:
        """Of a whole recording about a fit to some of its stretches."""
        every_s = max(WINDOW_S, whole.span[1] / MOST_WINDOWS)
        count = int(whole.span[1] // every_s) + 1
        std = _prior_std(fit.n)
        G, g = np.zeros((count, len(std), len(std))), np.zeros((count, len(std)))
        power, rows = np.zeros(count), np.zeros(count)
        for piece in pieces_of(fit, whole):
            own = piece.recordings[0]
            X, data = piece.whiten([_signatures(piece)]), piece.whiten(piece.model.residuals())
            place = np.repeat((own.t[ORDER:] // every_s).astype(int), fit.n)
            for w in np.unique(place):
                at = place == w
                G[w] += X[:, at] @ X[:, at].T
                g[w] += X[:, at] @ data[at]
                power[w] += float(data[at] @ data[at])
                rows[w] += float(at.sum())
        return cls(every_s, G, g, power, rows, std)

    def stretches(self) -> list[Span]:
        """Around changes, and where it is loud."""
        told = self.rows > 0.0
        usual = float(np.median(self.power[told] / self.rows[told]))
        loud = np.where(told, self.power / np.maximum(self.rows, 1.0), 0.0)
        out = [self._around(k) for k in self._changes(LEAST_CHI2 * max(usual, 1.0))]
        while len(out) < CHANGES + LOUD and loud.max() > LOUDER * usual:
            k = int(np.argmax(loud))
            middle = self.every_s * (k + 0.5)
            if not any(a <= middle <= b for a, b in out):
                out.append(self._around(k + 0.5))
            loud[max(k - 1, 0) : k + 2] = 0.0
        return out

    def _around(self, k: float) -> Span:
        middle = self.every_s * k
        return max(middle - 0.5 * STRETCH_S, 0.0), middle + 0.5 * STRETCH_S

    def _changes(self, least: float) -> list[int]:
        """First windows behind a change, those that explain most first."""
        found: list[int] = []
        spans = [(0, len(self.rows))]
        while spans and len(found) < CHANGES:
            tried = [(*self._best(a, b), (a, b)) for a, b in spans]
            chi2, k, span = max(tried)
            if chi2 < least:
                break
            found.append(k)
            spans.remove(span)
            spans += [(span[0], k), (k, span[1])]
        return found

    def _best(self, begin: int, end: int) -> tuple[float, int]:
        """What a change explains between two windows, and before which window it is."""
        G, g = np.cumsum(self.G[begin:end], axis=0), np.cumsum(self.g[begin:end], axis=0)
        if len(G) < 2 * MARGIN + 1:
            return 0.0, begin
        at = np.arange(MARGIN - 1, len(G) - MARGIN)
        before = self._chi2(G[at], g[at])
        behind = self._chi2(G[-1] - G[at], g[-1] - g[at])
        gain = before + behind - self._chi2(G[-1:], g[-1:])
        best = int(np.argmax(gain))
        return float(gain[best]), begin + int(at[best]) + 1

    def _chi2(self, G: Array, g: Array) -> Array:
        """(b,) what constant changes explain, with their prior."""
        A = G * np.outer(self.prior_std, self.prior_std) + np.eye(len(self.prior_std))
        b = g * self.prior_std
        return np.asarray(np.einsum("bi,bi->b", b, np.linalg.solve(A, b[..., None])[..., 0]))


def _of_joints() -> list[Effect]:
    """What may come in at once at a joint, and is linear."""
    return [e for e in CATALOGUE.values() if e.sudden and isinstance(e, LinearEffect)]


def _prior_std(n: int) -> Array:
    """(c,) of what may change: ten numbers of a body at the hand, then each effect's joints."""
    own = [effect.templates()[0].prior_std[0] for effect in _of_joints()]
    return np.concatenate([HELD.templates()[0].prior_std, np.repeat(own, n)])


def _signatures(piece: Fit) -> Array:
    """(c, k, n) of all that may change."""
    own, motion = piece.recordings[0], piece.recordings[0].motion
    at, unit = JointSignals(motion.q, motion.dq, motion.ddq), np.eye(piece.n)
    tables = [own.low_regressor[-10:]]
    for effect in _of_joints():
        column = own.low(effect.columns(at)[0])
        tables.append(column.T[:, :, None] * unit[:, None])
    return np.concatenate(tables)
