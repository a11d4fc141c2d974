"""How far the gap shrinks: torque and forward simulation on data that the fit never saw.

What was found in some stretches of a long recording is weighed on all, by its moments. Names,
dates, nonlinear settings and the noise are those of the stretches. Signatures and residuals are
computed piece by piece, their products are kept, and the pieces forgotten.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.ndimage import maximum_filter1d

from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.gap.evidence import Carried, Moments, Normal
from adapter.gap.findings import entries, noise_floor, posterior_of
from adapter.gap.fit import BLOCK, Fit, Model, place_of, refitted
from adapter.gap.folds import FOLD_S, FOLDS, block_s, fold_of, holds_out, without_each
from adapter.gap.long_recording import LongRecording
from adapter.gap.real_arm import SPRING
from adapter.gap.result import WORSE, Curves, RolloutCurves, Shortfall
from adapter.gap.search import Found, from_the_start
from adapter.gap.signals import COMMANDS, ROLLOUT_STEP_S, Recorded
from adapter.learning.batch.conic import solve_conic
from adapter.learning.batch.theta_filling import KEPT, UNSOLVED, Measure
from adapter.model.inertia import is_consistent
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.signals.validation import EDGE_S as RECIPE_EDGE_S
from adapter.signals.validation import smooth
from adapter.simulate import DrivenMotion, Simulate

WORST = 100.0  # rad, rad/s: a simulation that runs away


def model_of(
    model: SelfModel, fit: Fit, recording: int | None = None, known: Carried | Moments | None = None
) -> SelfModel:
    """The self model with the corrections and the named effects of a fit; see `entries`."""
    theta = model.theta.copy()
    theta[len(theta) - len(fit.dtheta) :] += fit.dtheta  # a floating base comes before the links
    effects = (*model.effects, *entries(fit, recording, known))
    posterior = None if known is None else posterior_of(fit, known)
    return replace(model, theta=theta, effects=effects, posterior=posterior)


def held_out_models(
    model: SelfModel, fit: Fit, carried: Carried | Moments
) -> list[list[SelfModel]]:
    """Of each recording one model per fold: refitted without that fold's blocks of time."""
    models: list[list[SelfModel]] = [[] for _ in fit.recordings]
    for known in without_each(fit, carried):
        try:
            own = [model_of(model, possible(fit.at(known.x), known), i) for i in range(len(models))]
        except ModelError:  # a coefficient at its bound without these data
            own = [model_of(model, fit, i) for i in range(len(models))]
        for each, one in zip(models, own, strict=True):
            each.append(one)
    return models


def possible(fit: Fit, known: Normal) -> Fit:
    """The fit at the most probable coefficients with which every body can exist.

    All coefficients give way together, each as far as the data and its prior let it: a link whose
    numbers are corrected alone takes the torques along.

    Args:
        fit: at coefficients that need not be possible.
        known: what is known of them.

    Raises:
        ModelError: the solver gave up without an answer.
    """
    nominal, change = _bodies(fit)
    learned = nominal + np.tensordot(fit.coefficients, change, 1)
    if not len(nominal) or is_consistent(learned):
        return fit
    measure = Measure(nominal)
    root = cholesky(known.G + np.diag(known.prior_std**-2.0), lower=True)
    # of coefficients one standard deviation away, each independent of the others
    slopes = solve_triangular(root, measure.of(change), lower=True)
    size = len(root)
    start = measure.of(learned) - KEPT * measure.own
    z, _, _ = solve_conic(np.eye(size), np.zeros(size), -slopes.T, start, measure.cones)
    found = fit.at(fit.coefficients + solve_triangular(root, z, lower=True, trans=1))
    if not is_consistent(nominal + np.tensordot(found.coefficients, change, 1)):
        raise ModelError(UNSOLVED)
    return found


def _bodies(fit: Fit) -> tuple[Array, Array]:
    """Nominal bodies (b, 10) and their change (c, b, 10) by unit coefficients.

    Each link, and each link with the bodies that were named on it and act at the same time. Left
    out is what cannot exist by the nominal model.
    """
    theta, size = fit.recordings[0].motion.arm.theta, len(fit.coefficients)
    link = {
        k: e.candidate.joint % fit.n
        for k, e in enumerate(fit.named)
        if e.candidate.columns_are_theta
    }
    parts: list[tuple[int, list[int]]] = [(j, []) for j in range(fit.n)]
    for k, j in link.items():
        begin, end = fit.named[k].interval_s
        others = [i for i in link if link[i] == j and fit.named[i].interval_s[0] < end]
        parts.append((j, [i for i in others if fit.named[i].interval_s[1] > begin]))
    parts = [part for part in parts if is_consistent(theta[part[0]])]
    change = np.zeros((size, len(parts), 10))
    for b, (j, named) in enumerate(parts):
        change[10 * j : 10 * j + 10, b] = np.eye(10)
        for k in named:
            change[place_of(fit, k), b] = fit.named[k].candidate.theta
    return theta[[j for j, _ in parts]], change


@dataclass(frozen=True, eq=False)
class ErrorsOverTime:
    """Errors by the recipe of `adapter.signals.validation`, (m, n) N m, at t (m,) s.

    NaN where the torque was not measured.
    """

    t: Array
    before: Array
    after: Array


def torque_errors(
    recording: Recorded, before: SelfModel, after: Sequence[SelfModel], block: float = FOLD_S
) -> ErrorsOverTime:
    """Measured less predicted torque; `after` has one model per fold of `block` s, or one."""
    if len(recording.begins) > 1:
        parts = [torque_errors(x, before, after, block) for x in recording.stretches()]
        columns = ([getattr(x, key) for x in parts] for key in ("t", "before", "after"))
        return ErrorsOverTime(*map(np.concatenate, columns))
    q, dq, ddq, tau = smooth(recording.t, recording.q, recording.dq, recording.tau)
    t = recording.t[0] + 1e-3 * np.arange(len(q))
    sharp, _, _ = recording.smoothed().at(t)
    old = tau - ModelTorque(before, own_log=True)(q, dq, ddq, t, sharp)
    fold = fold_of(t, block) % len(after)
    new = np.empty_like(old)
    for f, model in enumerate(after):
        rows = fold == f
        if rows.any():
            new[rows] = (tau - ModelTorque(model, own_log=True)(q, dq, ddq, t, sharp))[rows]
    unheard = maximum_filter1d(~recording.heard_at(t), 101, axis=0)  # ms that its filter mixes
    old[unheard] = new[unheard] = np.nan
    edge = round(RECIPE_EDGE_S / 1e-3)
    return ErrorsOverTime(t[edge:-edge], old[edge:-edge], new[edge:-edge])


def rms(errors: Sequence[Array]) -> Array:
    """(n,) root of the mean square of all tables' rows (m, n), NaN left out; NaN where none is."""
    table = np.concatenate(list(errors))
    told = np.isfinite(table)
    square = np.where(told, table, 0.0) ** 2
    return np.asarray(
        np.sqrt(square.sum(axis=0) / np.where(told.any(axis=0), told.sum(axis=0), np.nan))
    )


class RolloutErrors(NamedTuple):
    """Simulated less measured by row and joint, (k, n) rad and rad/s, and curves for a plot.

    Rows are those that both models could be simulated along; none where one could not at all.
    """

    before_q: Array
    before_dq: Array
    after_q: Array
    after_dq: Array
    curves: RolloutCurves


def rollout_errors(
    recording: Recorded,
    before: SelfModel,
    after: Sequence[SelfModel],
    simulate: Simulate,
    block: float = FOLD_S,
) -> RolloutErrors:
    """Forward simulation restarted from the data every 0.5 s.

    Each segment goes by the model of the fold that it starts in (blocks of `block` s).
    """
    if len(recording.begins) > 1:
        parts = [rollout_errors(x, before, after, simulate, block) for x in recording.stretches()]
        first, second, third, fourth = (np.concatenate([x[k] for x in parts]) for k in range(4))
        columns = ([getattr(x.curves, f.name) for x in parts] for f in fields(RolloutCurves))
        curves = RolloutCurves(*map(np.concatenate, columns))
        return RolloutErrors(first, second, third, fourth, curves)
    t = recording.grid()
    q, dq, _ = recording.smoothed().at(t)
    u, drive = recording.drive(t)
    heard = np.logical_or(recording.heard_at(t).all(axis=1), drive == COMMANDS)
    length = round(0.5 / ROLLOUT_STEP_S)  # half a second
    segments = [
        (a, b)  # the row at b is the next start
        for a, b in pairwise(range(0, len(t), length))
        if heard[a:b].all() and recording.is_whole(t[a], t[b - 1])
    ]
    motion = DrivenMotion(t, q, dq, u)
    old_q, old_dq = _along(segments, [before], simulate, motion, drive, block)
    new_q, new_dq = _along(segments, after, simulate, motion, drive, block)
    told = np.zeros(len(t), dtype=bool)
    for begin, end in segments:  # a simulation that was refused lacks even its start
        told[begin:end] = np.isfinite(old_q[begin]).all() and np.isfinite(new_q[begin]).all()
    thin = slice(None, None, 10)  # rollout rows kept for a plot: one in so many
    curves = RolloutCurves(t[thin], q[thin], old_q[thin], new_q[thin])
    return RolloutErrors(
        _off(old_q, q)[told],
        _off(old_dq, dq)[told],
        _off(new_q, q)[told],
        _off(new_dq, dq)[told],
        curves,
    )


def _along(
    segments: Sequence[tuple[int, int]],
    models: Sequence[SelfModel],
    simulate: Simulate,
    motion: DrivenMotion,
    drive: str,
    block: float,
) -> tuple[Array, Array]:
    """Simulated q, dq (m, n), NaN outside the segments; `models` has one per fold, or one."""
    out = np.full_like(motion.q, np.nan), np.full_like(motion.q, np.nan)
    for f, model in enumerate(models):
        t, count = motion.t, len(models)
        own = [s for s in segments if fold_of(t[s[0] : s[0] + 1], block)[0] % count == f]
        if own:
            found = simulate(model, motion, own, drive)
            for begin, end in own:
                for mine, part in zip(out, found, strict=True):
                    mine[begin:end] = part[begin:end]
    return out


def _off(simulated: Array, measured: Array) -> Array:
    """Error of a simulation; of one that ran away the worst that counts."""
    off = np.abs(simulated - measured)
    return np.minimum(np.where(np.isfinite(off), off, WORST), WORST)


@dataclass(frozen=True, eq=False)
class GapTask:
    """What there is to work with.

    Attributes:
        model: the nominal one.
        fitted, scored: recordings to fit and to score on; the same ones where blocks are held out.
        moving: joints (from 0) that move, per fitted recording.
        period_s: the longest sample period.
        one_clock: what is scored belongs to the recording that is fitted.
        notes: what is known of the logs.
    """

    model: SelfModel
    fitted: tuple[Recorded, ...]
    scored: tuple[Recorded, ...]
    moving: tuple[tuple[int, ...], ...]
    period_s: float
    one_clock: bool
    notes: tuple[str, ...]

    @property
    def folds(self) -> bool:
        """The fit's own recordings are scored, each block by a fit without it."""
        return self.fitted == self.scored


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The gap before and after, on data that the fit never saw.

    Attributes:
        found: what was searched for, without the corrections of the inertias where these do
            not pay.
        before, after: errors of the nominal model and of the new one.
        curves: one per fitted recording; rollouts: one per recording that was simulated.
    """

    found: Found
    before: Shortfall
    after: Shortfall
    curves: tuple[Curves, ...]
    rollouts: tuple[RolloutCurves, ...]


def measure(
    task: GapTask, found: Found, simulate: Simulate | None, progress: Callable[[str], None]
) -> HeldOut:
    """Score the nominal model and the new one where the new one was not fitted."""
    searched, found = found.fit, _paying(task, found)
    whole = task.fitted[0]
    if isinstance(whole, LongRecording) and len(task.fitted) == 1:
        progress("weighing it on the whole recording")
        found = weighed(found, whole)
    fit = possible(found.fit, found.carried)
    found = replace(found, fit=replace(fit, noise=searched.noise, doubts=searched.doubts))
    block = block_s(found.fit)
    if task.folds and holds_out(found.fit):
        after = held_out_models(task.model, found.fit, found.carried)
    elif task.folds:  # too short: in sample only
        after = [[model_of(task.model, found.fit, i)] for i in range(len(task.fitted))]
    else:
        model = model_of(task.model, found.fit)
        after = [[model if task.one_clock else lasting(model)]] * len(task.scored)
    pairs = list(zip(task.scored, after, strict=True))
    errors = [torque_errors(r, task.model, own, block) for r, own in pairs]
    runs: list[RolloutErrors] = []
    if simulate is not None:
        progress("simulating forward")
        runs = [rollout_errors(r, task.model, own, simulate, block) for r, own in pairs]

    def rollout(key: str) -> Array | None:
        return rms([getattr(run, key) for run in runs]) if runs else None

    return HeldOut(
        found,
        Shortfall(rms([e.before for e in errors]), rollout("before_q"), rollout("before_dq")),
        Shortfall(rms([e.after for e in errors]), rollout("after_q"), rollout("after_dq")),
        tuple(_curves(r.name, found, i) for i, r in enumerate(task.fitted)),
        tuple(x.curves for x in runs),
    )


def lasting(model: SelfModel) -> SelfModel:
    """The model in another recording: its effects that had not ended, at all times."""
    kept = []
    for entry in model.effects:
        begin, end = entry.get("interval_s") or (None, None)
        if end is None:
            kept.append(dict(entry, interval_s=None) if begin is not None else entry)
    return replace(model, effects=tuple(kept))


@dataclass(frozen=True, eq=False)
class _Scored:
    """What was found, and its errors on the blocks that it was fitted without.

    Attributes:
        before, after: (n,) rms N m, of the nominal model and of the new one; level: of the noise.
    """

    found: Found
    before: Array
    after: Array
    level: Array

    @classmethod
    def of(cls, task: GapTask, found: Found, level: Array) -> _Scored:
        """Scored by folds of the fitted recordings."""
        block, models = block_s(found.fit), held_out_models(task.model, found.fit, found.carried)
        pairs = zip(task.fitted, models, strict=True)
        errors = [torque_errors(r, task.model, folds, block) for r, folds in pairs]
        before, after = (rms([getattr(e, key) for e in errors]) for key in ("before", "after"))
        return cls(found, before, after, level)

    @property
    def cost(self) -> float:
        """Of all joints."""
        heard = np.isfinite(self.after)
        return float(np.sum((self.after[heard] / self.level[heard]) ** 2))

    @property
    def worse(self) -> NDArray[np.bool_]:
        """(n,) joints that the new model makes worse."""
        return np.asarray(self.after > (1.0 + WORSE) * self.before)


def _paying(task: GapTask, found: Found) -> Found:
    """As it foretells held-out data best: what is assumed, corrections, single effects."""
    level = noise_floor(found.fit)
    ways = [found, uncorrected(found)]
    loaded = any(map(from_the_start, found.fit.named))  # it is weighed beside all of the rest
    # springs that any arm may have and these data do not single out
    springs = [k for k in found.weak if found.fit.named[k].candidate.effect is SPRING]
    for places in (found.weak, springs) if not loaded else ():
        if places:
            fewer = _without(found, places)
            ways += [fewer, uncorrected(fewer)]
    best = min((_Scored.of(task, x, level) for x in ways), key=lambda x: x.cost)
    while best.worse.any() and best.found.fit.named:
        fit, less = best.found.fit, []
        for k, e in enumerate(fit.named):  # less one effect that acts on one of these joints
            size = np.abs(fit.model.contribution(e.recording or 0, k)).max(axis=0)
            if not from_the_start(e) and (size[best.worse] > 0.1 * size.max()).any():
                fewer = _without(best.found, (k,))
                fewer = fewer if fit.dtheta.any() else uncorrected(fewer)
                less.append(_Scored.of(task, fewer, level))
        if not less or min(x.cost for x in less) > best.cost:
            break
        best = min(less, key=lambda x: x.cost)
    return best.found


def _without(found: Found, places: Collection[int]) -> Found:
    """What was found less some of its effects."""
    left = [k for k in range(len(found.fit.named)) if k not in places]
    fit, carried = refitted(found.fit.with_named([found.fit.named[k] for k in left]))
    standings = tuple(found.standings[k] for k in left)
    weak = frozenset(i for i, k in enumerate(left) if k in found.weak)
    return replace(
        found, fit=fit, carried=carried, standings=standings, weak=weak, known=None, under=None
    )


def uncorrected(found: Found) -> Found:
    """The same effects fitted with the nominal inertias.

    What is known of the coefficients stays what is known with the inertias free within their
    prior: that they are left alone does not make them any surer.
    """
    fit, carried = refitted(replace(found.fit, prior=1e-4 * found.fit.prior))  # next to none
    model = replace(fit.model, dtheta=np.zeros_like(fit.dtheta))
    kept = replace(fit, model=model, prior=found.fit.prior)
    return replace(found, fit=kept, carried=carried, known=kept.carried(), under=fit)


def _curves(name: str, found: Found, i: int) -> Curves:
    """What is shown of the i-th fitted recording, called `name`."""
    own, model = found.fit.recordings[i], found.fit.model
    nominal = Model((own,), np.zeros_like(found.fit.dtheta), known=model.known)
    after = np.empty_like(own.tau)
    for f, known in enumerate(without_each(found.fit, found.carried)):
        rows = fold_of(own.t, block_s(found.fit)) == f
        fit = found.fit.at(known.x)
        named = fit.with_named([e for e in fit.named if not e.is_pattern])
        after[rows] = named.model.residual(i)[rows]
    motion = own.motion
    rows = np.searchsorted(motion.t, own.t - 1e-9)
    signals = motion.q[rows], motion.dq[rows], motion.ddq[rows]
    return Curves(name, own.t, *signals, own.tau, nominal.residual(0), after)


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
    G, g, seconds = np.zeros((FOLDS, c, c)), np.zeros((FOLDS, c)), np.zeros((c, c))
    block = block_s(fit)
    for part in pieces_of(fit, whole):
        N, left = part.whiten([part.model.signatures(0)]), part.whiten(part.model.residuals())
        data = left + fit.coefficients @ N
        fold = np.repeat(fold_of(part.recordings[0].t, block), n)
        for f in range(FOLDS):
            own = N[:, fold == f]
            G[f] += own @ own.T
            g[f] += own @ data[fold == f]
        sums = np.add.reduceat(N * left, np.arange(0, len(left), BLOCK * n), axis=1)
        seconds += sums @ sums.T
    return Moments((G, g), fit.prior_std, seconds)


def pieces_of(fit: Fit, whole: LongRecording) -> Iterator[Fit]:
    """A fit on each piece of a recording, under its noise."""
    for own in whole.pieces(fit.recordings[0]):
        model = replace(fit.model, recordings=(own,))
        piece = replace(fit, model=model, doubts=())
        yield piece.with_noise(fit.noise) if fit.doubts else piece
