"""How far the gap shrinks: torque and forward simulation on data that the fit never saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.errors import ModelError
from adapter.gap.evidence import Carried
from adapter.gap.findings import entries
from adapter.gap.fit import Fit
from adapter.gap.recorded import STEP_S, Recorded
from adapter.gap.result import RolloutCurves
from adapter.gap.rivals import FOLD_S, FOLDS, fold_of, fold_rows
from adapter.inertia import is_consistent
from adapter.model import SelfModel
from adapter.records import Array
from adapter.torque import ModelTorque
from adapter.validation import EDGE_S as RECIPE_EDGE_S
from adapter.validation import smooth

SEGMENT_S = 0.5
THINNED = 10  # rollout rows kept for a plot: one in so many
WORST = 100.0  # rad, rad/s: a simulation that runs away

# (model, t, q, dq, u, segments, drive) -> simulated q, dq (m, n), NaN outside the segments and
# all over where the model cannot be simulated
Simulate = Callable[
    [SelfModel, Array, Array, Array, Array, Sequence[tuple[int, int]], str], tuple[Array, Array]
]


def model_of(model: SelfModel, fit: Fit) -> SelfModel:
    """The self model with the corrections and the named effects of a fit.

    A correction that would make a body impossible is taken back as far as it must be.
    """
    theta = model.theta.copy()
    first = len(theta) - len(fit.dtheta)  # a floating base comes before the links
    for k, change in enumerate(fit.dtheta, start=first):
        share = 1.0
        while not is_consistent(theta[k] + share * change) and is_consistent(theta[k]):
            share *= 0.7
            if share < 1e-3:
                share = 0.0
                break
        theta[k] += share * change
    return replace(model, theta=theta, effects=(*model.effects, *entries(fit)))


def held_out_coefficients(fit: Fit, carried: Carried) -> list[Array]:
    """Coefficients of a fit, one set per fold, each without that fold's blocks of time.

    Names, dates and the noise are those that all data gave; what is fitted is refitted.
    """
    fold = fold_rows(fit)
    seen = [fold != f for f in range(FOLDS)]
    return [Carried(carried.N[:, s], carried.prior_std, carried.data[s]).x for s in seen]


def held_out_models(model: SelfModel, fit: Fit, carried: Carried) -> list[SelfModel]:
    """One model per fold: the named effects refitted without that fold's blocks of time."""
    models = []
    for x in held_out_coefficients(fit, carried):
        try:
            models.append(model_of(model, fit.at(x)))
        except ModelError:  # a coefficient at its bound without these data
            models.append(model_of(model, fit))
    return models


@dataclass(frozen=True, eq=False)
class TorqueErrors:
    """Errors by the recipe of `adapter.validation`, (m, n) N m, at t (m,) s."""

    t: Array
    before: Array
    after: Array


def torque_errors(
    recording: Recorded, before: SelfModel, after: Sequence[SelfModel], block: float = FOLD_S
) -> TorqueErrors:
    """Measured less predicted torque; `after` has one model per fold of `block` s, or one."""
    q, dq, ddq, tau = smooth(recording.t, recording.q, recording.dq, recording.tau)
    t = recording.t[0] + 1e-3 * np.arange(len(q))
    old = tau - ModelTorque(before)(q, dq, ddq, t)
    fold = fold_of(t, block) % len(after)
    new = np.empty_like(old)
    for f, model in enumerate(after):
        rows = fold == f
        if rows.any():
            new[rows] = (tau - ModelTorque(model)(q, dq, ddq, t))[rows]
    edge = round(RECIPE_EDGE_S / 1e-3)
    return TorqueErrors(t[edge:-edge], old[edge:-edge], new[edge:-edge])


def rms(errors: Sequence[Array]) -> Array:
    """(n,) root of the mean square over all rows of all tables; NaN where there is no row."""
    table = np.concatenate(list(errors))
    if not len(table):
        return np.full(table.shape[1], np.nan)
    return np.sqrt(np.mean(np.square(table), axis=0))


@dataclass(frozen=True, eq=False)
class RolloutErrors:
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
    t = recording.grid()
    q, dq, _ = recording.smoothed().at(t)
    u, drive = recording.drive(t)
    segments = [s for s in _segments(len(t)) if recording.is_whole(t[s[0]], t[s[1] - 1])]
    old = _along(segments, [before], simulate, (t, q, dq, u), drive, block)
    new = _along(segments, after, simulate, (t, q, dq, u), drive, block)
    told = np.zeros(len(t), dtype=bool)
    for begin, end in segments:  # a simulation that was refused lacks even its start
        told[begin:end] = np.isfinite(old[0][begin]).all() and np.isfinite(new[0][begin]).all()
    thin = slice(None, None, THINNED)
    curves = RolloutCurves(t[thin], q[thin], old[0][thin], new[0][thin])
    return RolloutErrors(
        _off(old[0], q)[told],
        _off(old[1], dq)[told],
        _off(new[0], q)[told],
        _off(new[1], dq)[told],
        curves,
    )


def _segments(rows: int) -> list[tuple[int, int]]:
    """[start, stop) of 0.5 s each; the row at stop is the next start."""
    length = round(SEGMENT_S / STEP_S)
    return [(k, k + length) for k in range(0, rows - length, length)]


def _along(
    segments: Sequence[tuple[int, int]],
    models: Sequence[SelfModel],
    simulate: Simulate,
    table: tuple[Array, Array, Array, Array],
    drive: str,
    block: float,
) -> tuple[Array, Array]:
    """Simulated q, dq (m, n), NaN outside the segments; `models` has one per fold, or one."""
    t, q, dq, u = table
    out = np.full_like(q, np.nan), np.full_like(q, np.nan)
    for f, model in enumerate(models):
        own = [s for s in segments if fold_of(t[s[0] : s[0] + 1], block)[0] % len(models) == f]
        if own:
            found = simulate(model, t, q, dq, u, own, drive)
            for begin, end in own:
                for mine, part in zip(out, found, strict=True):
                    mine[begin:end] = part[begin:end]
    return out


def _off(simulated: Array, measured: Array) -> Array:
    """Error of a simulation; of one that ran away the worst that counts."""
    off = np.abs(simulated - measured)
    return np.minimum(np.where(np.isfinite(off), off, WORST), WORST)
