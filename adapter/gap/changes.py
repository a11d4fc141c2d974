"""When something changed in a long recording: looked for in all of it, before the search.

A plain model (what any arm has, fitted to some stretches) leaves a residual. Of every window of
some seconds its products with what may change at once are kept: a body at the hand, and offset
and friction of each joint. A change at some time shows as a difference between all windows before
it and all behind it; something that comes and goes, as a window that is much louder than usual.
The search then gets rows around these times, and decides what it was and when.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.base import Effect, LinearEffect
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import CATALOGUE, HELD
from adapter.gap.fit import EDGE_S, Fit
from adapter.gap.held_out import pieces_of
from adapter.gap.long_recording import LongRecording, Span
from adapter.gap.real_arm import load_in, loaded_arm, nominal_fit, real_arm
from adapter.gap.signals import RATE_HZ, regressor_of
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.screening.screen import moving_joints

WINDOW_S, MOST_WINDOWS = 2.0, 2048
CHANGES, LOUD = 3, 1  # stretches that are added at most: around changes, where it is loud
AROUND_S = 4.0  # length of one
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
        own_std = [effect.templates()[0].prior_std[0] for effect in _of_joints()]
        std = np.concatenate([HELD.templates()[0].prior_std, np.repeat(own_std, fit.n)])
        G, g = np.zeros((count, len(std), len(std))), np.zeros((count, len(std)))
        power, rows = np.zeros(count), np.zeros(count)
        for piece in pieces_of(fit, whole):
            own = piece.recordings[0]
            X, data = piece.whiten([_signatures(piece)]), piece.whiten(piece.model.residuals())
            place = np.repeat((own.t // every_s).astype(int), fit.n)
            for w in np.unique(place):
                at = place == w
                G[w] += X[:, at] @ X[:, at].T
                g[w] += X[:, at] @ data[at]
                power[w] += float(data[at] @ data[at])
                rows[w] += float(at.sum())
        return cls(every_s, G, g, power, rows, std)

    @property
    def usual(self) -> float:
        """Power of a row in the middle one of the windows."""
        told = self.rows > 0.0
        return float(np.median(self.power[told] / self.rows[told]))

    @cached_property
    def changes(self) -> list[int]:
        """First windows behind a change, those that explain most first."""
        found: list[int] = []
        spans = [(0, len(self.rows))]
        while spans and len(found) < CHANGES:
            chi2, k, span = max((*self._best(*span), span) for span in spans)
            if chi2 < 200.0 * max(self.usual, 1.0):  # above what windows scatter
                break
            found.append(k)
            spans.remove(span)
            spans += [(span[0], k), (k, span[1])]
        return found

    @property
    def loads_s(self) -> list[float]:
        """About when the hand picked something up or put it down, s."""
        body, ends = np.arange(10), sorted([0, *self.changes, len(self.rows)])
        out = []
        for begin, k, end in zip(ends, ends[1:], ends[2:], strict=False):
            whole, alone = (self._gain(begin, end, [k], at)[0] for at in (slice(None), body))
            if alone > 0.7 * whole:  # of what a change explains: it is one of the load
                out.append(self.every_s * k)
        return out

    def stretches(self) -> list[Span]:
        """Around changes, and where it is loud."""
        usual = self.usual
        loud = np.where(self.rows > 0.0, self.power / np.maximum(self.rows, 1.0), 0.0)
        out = [self._around(k) for k in self.changes]
        while len(out) < CHANGES + LOUD and loud.max() > 4.0 * usual:  # times the usual power
            k = int(np.argmax(loud))
            middle = self.every_s * (k + 0.5)
            if not any(a <= middle <= b for a, b in out):
                out.append(self._around(k + 0.5))
            loud[max(k - 1, 0) : k + 2] = 0.0
        return out

    def _around(self, k: float) -> Span:
        middle = self.every_s * k
        return max(middle - 0.5 * AROUND_S, 0.0), middle + 0.5 * AROUND_S

    def _best(self, begin: int, end: int) -> tuple[float, int]:
        """What a change explains between two windows, and before which window it is."""
        if end - begin < 2 * MARGIN + 1:
            return 0.0, begin
        places = np.arange(begin + MARGIN, end - MARGIN + 1)
        gain = self._gain(begin, end, places)
        best = int(np.argmax(gain))
        return float(gain[best]), int(places[best])

    def _gain(
        self, begin: int, end: int, places: Sequence[int] | np.ndarray, at: Any = slice(None)
    ) -> Array:
        """What changes before some of the windows from `begin` to `end` explain, each alone.

        Args:
            at: which of the signatures may change.
        """
        G = np.cumsum(self.G[begin:end, at][:, :, at], axis=0)
        g, std = np.cumsum(self.g[begin:end, at], axis=0), self.prior_std[at]
        k = np.asarray(places) - begin - 1
        both = _chi2(G[k], g[k], std) + _chi2(G[-1] - G[k], g[-1] - g[k], std)
        return np.asarray(both - _chi2(G[-1:], g[-1:], std))


def _chi2(G: Array, g: Array, prior_std: Array) -> Array:
    """(b,) what signatures with products G (b, c, c), with the data g (b, c), explain."""
    A = G * np.outer(prior_std, prior_std) + np.eye(len(prior_std))
    b = g * prior_std
    return np.asarray(np.einsum("bi,bi->b", b, np.linalg.solve(A, b[..., None])[..., 0]))


def with_changes(own: LongRecording, model: SelfModel, inertia_prior: float) -> LongRecording:
    """A recording with stretches where something changes or is loud, and when its load does."""
    nominal = nominal_fit([own], model, inertia_prior, own.survey.clock.period_s)
    motion = nominal.recordings[0].motion
    moving = nominal.heard.intersection(moving_joints(motion.q, motion.dq, 1.0 / RATE_HZ))
    windows = Windows.of(real_arm(nominal, sorted(moving), (0,)).fit.with_noise(), own)
    own = own.taking([*own.survey.spread(own.span), *windows.stretches()])
    return replace(own, loads_s=tuple(windows.loads_s))


def loaded(nominal: Fit, joints: Sequence[int], times_s: Sequence[float]) -> Fit:
    """The nominal model with the loads that its hand has from some times on.

    Args:
        nominal: on stretches of a long recording, some of them around these times.
        joints: (from 0) that move; times_s: about when the load changed.
    """
    load = load_in(nominal, None)
    loads = [load, *(replace(load, interval_s=(t, np.inf)) for t in times_s)]
    for _ in range(2):  # rounds in which the date of a load is sought
        arm = loaded_arm(nominal, joints, loads)
        loads = [replace(e, interval_s=_dated(arm.fit, k)) for k, e in enumerate(loads)]
    arm = loaded_arm(nominal, joints, loads)
    there = [k for k in range(len(loads)) if k > 0 or arm.is_there(k)]
    return nominal.with_named([arm.fit.named[k] for k in there])


def _dated(fit: Fit, k: int) -> Span:
    """The interval of a load, its beginning where the rows around like it best."""
    begin, end = fit.named[k].interval_s
    if not np.isfinite(begin):
        return begin, end
    named = fit.named[k]
    bare = replace(fit, doubts=())
    with_it = bare.instead(k, replace(named, interval_s=WHOLE))
    sizes = []
    for trial in (bare.without(k), with_it):
        white = trial.whiten(trial.model.residuals())
        sizes.append(np.square(white).reshape(-1, fit.n).sum(axis=1))
    t = fit.recordings[0].t
    near = np.flatnonzero(np.abs(t - begin) < AROUND_S)
    if not len(near):
        return begin, end
    # of each row being the first with the load: those before it are without
    cost = np.cumsum(sizes[0][near] - sizes[1][near]) - (sizes[0][near] - sizes[1][near])
    return float(t[near[int(np.argmin(cost))]]) - EDGE_S, end


def _of_joints() -> list[Effect]:
    """What may come in at once at a joint, and is linear."""
    return [e for e in CATALOGUE.values() if e.sudden and isinstance(e, LinearEffect)]


def _signatures(piece: Fit) -> Array:
    """(c, k, n) of all that may change: a body at the hand, then each effect's joints."""
    own, motion = piece.recordings[0], piece.recordings[0].motion
    at, unit = JointSignals(motion.q, motion.dq, motion.ddq), np.eye(piece.n)
    body = own.low_of(lambda rows: regressor_of(motion, rows)[:, :, -10:])
    tables = [np.moveaxis(body, 2, 0)]
    for effect in _of_joints():
        column = own.low(effect.columns(at)[0])
        tables.append(column.T[:, :, None] * unit[:, None])
    return np.concatenate(tables)
