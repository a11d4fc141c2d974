"""How far the gap shrinks: torque and forward simulation on data that the fit never saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.errors import ModelError
from adapter.gap.evidence import Carried
from adapter.gap.findings import entries
from adapter.gap.fit import Fit
from adapter.gap.recorded import EDGE_S, STEP_S, Recorded
from adapter.gap.result import RolloutCurves
from adapter.gap.rivals import FOLD_S, FOLDS, fold_rows
from adapter.inertia import is_consistent
from adapter.model import SelfModel
from adapter.records import Array
from adapter.torque import ModelTorque
from adapter.validation import EDGE_S as RECIPE_EDGE_S
from adapter.validation import smooth

SEGMENT_S = 0.5
THINNED = 10  # rollout rows kept for a plot: one in so many
WORST_RAD = 100.0  # a simulation that runs away

# (model, t, q, dq, u, segments, drive) -> simulated q, dq (m, n), NaN outside the segments
Simulate = Callable[
    [SelfModel, Array, Array, Array, Array, Sequence[tuple[int, int]], str], tuple[Array, Array]
]


def model_of(model: SelfModel, fit: Fit) -> SelfModel:
    """The self model with the corrections and the named effects of a fit.

    A correction that would make a body impossible is taken back as far as it must be.
    """
    theta = model.theta.copy()
    for k, change in enumerate(fit.dtheta):
        share = 1.0
        while not is_consistent(theta[k] + share * change) and is_consistent(theta[k]):
            share *= 0.7
            if share < 1e-3:
                share = 0.0
                break
        theta[k] += share * change
    return replace(model, theta=theta, effects=(*model.effects, *entries(fit)))


def held_out_models(model: SelfModel, fit: Fit, carried: Carried) -> list[SelfModel]:
    """One model per fold: the named effects refitted without that fold's blocks of time."""
    fold, models = fold_rows(fit), []
    for f in range(FOLDS):
        seen = fold != f
        x = Carried(carried.N[:, seen], carried.prior_std, carried.data[seen]).x
        try:
            models.append(model_of(model, fit.at(x)))
        except ModelError:  # a coefficient at its bound without these data
            models.append(model_of(model, fit))
    return models


def fold_of(t: Array) -> np.ndarray:
    """(m,) fold of each instant."""
    return np.asarray((t // FOLD_S).astype(int) % FOLDS)


@dataclass(frozen=True, eq=False)
class TorqueErrors:
    """Errors by the recipe of `adapter.validation`, (m, n) N m, at t (m,) s."""

    t: Array
    before: Array
    after: Array


def torque_errors(
    recording: Recorded, before: SelfModel, after: Sequence[SelfModel]
) -> TorqueErrors:
    """Measured less predicted torque; `after` holds one model per fold, or one for all."""
    q, dq, ddq, tau = smooth(recording.t, recording.q, recording.dq, recording.tau)
    t = recording.t[0] + 1e-3 * np.arange(len(q))
    old = tau - ModelTorque(before)(q, dq, ddq, t)
    fold = fold_of(t) % len(after)
    new = np.empty_like(old)
    for f, model in enumerate(after):
        rows = fold == f
        if rows.any():
            new[rows] = (tau - ModelTorque(model)(q, dq, ddq, t))[rows]
    edge = round(RECIPE_EDGE_S / 1e-3)
    return TorqueErrors(t[edge:-edge], old[edge:-edge], new[edge:-edge])


def rms(errors: Sequence[Array]) -> Array:
    """(n,) root of the mean square over all rows of all tables."""
    table = np.concatenate(list(errors))
    return np.sqrt(np.mean(np.square(table), axis=0))


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Squared errors by row and joint, (m, n), and curves for a plot."""

    before_q: Array
    before_dq: Array
    after_q: Array
    after_dq: Array
    curves: RolloutCurves


def rollout_errors(
    recording: Recorded, before: SelfModel, after: Sequence[SelfModel], simulate: Simulate
) -> RolloutErrors:
    """Forward simulation restarted from the data every 0.5 s, each segment by the model of its
    fold."""
    span = recording.t[-1] - recording.t[0] - 2 * EDGE_S
    t = recording.t[0] + EDGE_S + STEP_S * np.arange(int(span / STEP_S))
    q, dq, _ = recording.smoothed().at(t)
    u, drive = recording.drive(t)
    rows = round(SEGMENT_S / STEP_S)
    segments = [(k, k + rows) for k in range(0, len(t) - rows, rows)]
    old = simulate(before, t, q, dq, u, segments, drive)
    new = np.full_like(q, np.nan), np.full_like(q, np.nan)
    for f, model in enumerate(after):
        own = [s for s in segments if fold_of(t[s[0] : s[0] + 1])[0] % len(after) == f]
        if own:
            found = simulate(model, t, q, dq, u, own, drive)
            for begin, end in own:
                for table, part in zip(new, found, strict=True):
                    table[begin:end] = part[begin:end]
    thin = slice(None, None, THINNED)
    curves = RolloutCurves(t[thin], q[thin], old[0][thin], new[0][thin])
    squares = [
        np.minimum(np.nan_to_num(np.abs(mine - true), nan=0.0), WORST_RAD)[: segments[-1][1]]
        for mine, true in ((old[0], q), (old[1], dq), (new[0], q), (new[1], dq))
    ]
    return RolloutErrors(*squares, curves)
