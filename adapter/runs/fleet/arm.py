"""One arm from the moments of its recordings: its model, and what each recording tells beside it.

Inertias, friction and offsets are common to those that agree. A recording whose hand is heavier or
lighter than is usual on this arm (the median) carries a body of its own, which is solved for with
all else and taken off its moments. λ is the documented one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from adapter.learning.learner import OnlineLearner
from adapter.learning.theta import PRIOR_STD, Theta
from adapter.learning.theta_kernels import Moments
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.runs.fleet.course import CHANCE, TINY, Drift, Series, StandsOut, courses
from adapter.runs.fleet.moments import EPOCH_S, LogMoments, learner_of, learning_of
from adapter.runs.outcome import Outcome, collect, learned_model

ROUNDS = 5  # of who agrees to the model that these make
LEAST_LOAD_KG, LOAD_STD = 0.05, 4.0  # less than this, or so many standard deviations, is no load
FEWEST_TO_COMPARE = 3  # logs
DAY_S = 86_400.0
TIME = "time"  # the column that every log has


class Load(NamedTuple):
    """What a recording's hand carries more than is usual, kg, and its standard deviation."""

    mass: float
    std: float


@dataclass(frozen=True, eq=False)
class OfLog:
    """What one recording tells beside the arm's model.

    Attributes:
        moments: of the recording, as they were taken.
        used: whether the arm's model is learned from it, too; not where it disagrees.
        load: None where the hand is as usual.
        effects, effects_std: (e, n) of this recording alone, inertias being the arm's.
        rmse, own_rmse: (n,) N m of the arm's model, and of the best one for this recording alone.
        disagrees: joints (from 1) that the arm's model fits much worse than that one, and than it
            fits other recordings.
        worth: information that the same motion once more would add, nats per parameter.
    """

    moments: LogMoments
    used: bool
    load: Load | None
    effects: Array
    effects_std: Array
    rmse: Array
    own_rmse: Array
    disagrees: tuple[int, ...]
    worth: float


@dataclass(frozen=True, eq=False)
class FleetArm:
    """What a fleet knows of one arm.

    Attributes:
        name: of the arm.
        model: learned from all recordings that agree, where these are the most.
        outcome: of the learner, for whatever reads those.
        solution: (P,) (θ, effects), before bodies are made possible.
        effects: names of what was learned beside θ.
        logs: in the order of their begin.
        drifts: the clearest first.
        standing_out: friction and offsets of single recordings, by their number in `logs`.
    """

    name: str
    model: SelfModel
    outcome: Outcome
    solution: Array
    effects: tuple[str, ...]
    logs: tuple[OfLog, ...]
    drifts: tuple[Drift, ...]
    standing_out: tuple[StandsOut, ...]


def learn_arm(
    name: str,
    found: Sequence[LogMoments],
    documented: SelfModel,
    told: Mapping[str, Mapping[str, float]] | None = None,
) -> FleetArm:
    """Learn an arm's model.

    Args:
        name: of the arm.
        found: moments of its recordings, at least one; the order has no say.
        documented: the arm as the moments were taken with it.
        told: numbers that a manifest tells of recordings, by content and column.
    """
    found = sorted(found, key=lambda x: x.content)
    used = list(found)
    for number in range(ROUNDS):
        learner, loads = _learned(documented, used)
        logs = _of_logs(learner, found, used, loads)
        agreeing = {x.moments.content for x in logs if not x.disagrees}
        told_apart = agreeing != {x.content for x in used} and 2 * len(agreeing) > len(found)
        if number == ROUNDS - 1 or not told_apart:
            break
        used = [x for x in found if x.content in agreeing]
    learner.start_theta(round(1e9 * min(x.begin_s for x in used)))
    learner.learned = sum(x.samples for x in used)
    theta, outcome, effects = learner.theta, collect(learner), learning_of(documented).effects
    model = learned_model(outcome, documented, fleet=[x.path for x in used])
    drifts, out = courses(_series(logs, effects), _columns(logs, told or {}))
    solution = theta.th.copy()
    return FleetArm(name, model, outcome, solution, effects, logs, tuple(drifts), tuple(out))


def _learned(
    documented: SelfModel, used: Sequence[LogMoments]
) -> tuple[OnlineLearner, dict[str, tuple[Array, float]]]:
    """A learner with the sum of all moments, loads taken off, and the loads by content."""
    learner = learner_of(documented)
    theta = learner.theta
    _pool(theta, used, {})
    loads: dict[str, tuple[Array, float]] = {}
    for _ in range(4 if len(used) >= FEWEST_TO_COMPARE else 0):  # of loads to weights
        before, loads = loads, _loads(theta, used)
        if not before and not loads:
            break
        _pool(theta, used, {key: phi for key, (phi, _) in loads.items()})
    return learner, loads


def _pool(theta: Theta, found: Sequence[LogMoments], loads: Mapping[str, Array]) -> None:
    """Put the sum of all moments in place, loads taken off, and solve for (θ, effects)."""
    # one after the other, so that no more than two are made at once
    A = reduce(np.add, (_without(theta, log.A, loads.get(log.content)) for log in found))
    count = sum(log.count for log in found)
    counts = np.full(theta.tree.n, count)
    theta.replace_moments(Moments(A, *theta.moments[1:4], counts), count)
    for _ in range(6):  # weights and priors follow what was found with those before
        theta.th[:] = theta.least_squares()
        theta.adapt_prior()
    theta.th[:] = _solution(theta)


def _solution(theta: Theta) -> Array:
    """Least squares, refined once in more digits, since rounding reaches 1e-9 of the deviations."""
    th, at = theta.least_squares(), theta.known()
    H, rhs = theta.information()
    wide = np.longdouble
    left = rhs.astype(wide)[at] - H.astype(wide)[np.ix_(at, at)] @ th.astype(wide)[at]
    th[at] += np.linalg.solve(H[np.ix_(at, at)], left.astype(float))
    return th


def _without(theta: Theta, A: Array, load: Array | None) -> Array:
    """Moments A as they were without a body (10,) at the hand: torques are less by its own."""
    if load is None:
        return A
    rows, out = theta.rows, A.copy()
    for j, size in enumerate(rows.sizes):
        at = np.flatnonzero(
            (rows.place[j, :size] >= theta.hand.start) & (rows.place[j, :size] < theta.hand.stop)
        )
        if not len(at):
            continue
        less = np.eye(size + 1)
        less[at, -1] = -load[rows.place[j, at] - theta.hand.start]
        moments = less.T @ theta.joint_moments(j, A) @ less
        upper = np.triu_indices(size + 1)
        out[rows.starts[j] : rows.starts[j] + len(upper[0])] = moments[upper]
    return out


def _loads(theta: Theta, found: Sequence[LogMoments]) -> dict[str, tuple[Array, float]]:
    """Bodies (10,) beside the usual hand, and the standard deviations of their masses."""
    every = _solved(theta, found, range(len(found)))
    masses = np.array([x.body[0] for x in every])
    usual = every[np.argsort(masses)[len(masses) // 2]]
    std = np.array([_mass_std(theta, x, usual) for x in every])
    beyond = np.abs(masses - usual.body[0]) > np.maximum(LEAST_LOAD_KG, LOAD_STD * std)
    loaded = [k for k, x in enumerate(beyond) if x]
    again = _solved(theta, found, loaded)
    pairs = zip(loaded, again, strict=True)
    return {found[k].content: (x.body, _mass_std(theta, x, None)) for k, x in pairs}


class Body(NamedTuple):
    """What is found at the hand in one recording.

    Attributes:
        body: (10,) beside the hand that is common to all.
        alone: (10, 10) its covariance if the arm were known.
        follows: (10, P) how it follows what the arm is.
        arm: (P, P) covariance of that.
    """

    body: Array
    alone: Array
    follows: Array
    arm: Array


def _mass_std(theta: Theta, ours: Body, other: Body | None) -> float:
    """Standard deviation of a body's mass, kg, or of the difference to another one's.

    What is common to all hands nobody knows; in a difference it is gone.
    """
    known = theta.known()
    follows, variance = ours.follows[0, known], ours.alone[0, 0]
    if other is not None and other is not ours:
        follows, variance = follows - other.follows[0, known], variance + other.alone[0, 0]
    return float(np.sqrt(variance + follows @ ours.arm @ follows))


def _solved(theta: Theta, found: Sequence[LogMoments], loaded: Sequence[int]) -> list[Body]:
    """Bodies at the hands of `loaded`, the arm's θ being common.

    A body acts as the hand does; it is eliminated from the information of its recording, and found
    when all others have said what the arm is (Schur complement).
    """
    hand, weights = theta.hand, theta.weights()
    H, rhs = theta.data_information(reduce(np.add, (x.A for x in found)), weights)
    H, rhs = H + theta.prior, rhs + theta.prior_rhs
    for k in loaded:
        own, side = theta.data_information(found[k].A, weights)
        gain = _gain(own, hand)
        H -= own[:, hand] @ gain
        rhs -= gain.T @ side[hand]
    known = theta.known()
    inverse = np.asarray(np.linalg.inv(H[np.ix_(known, known)]), dtype=float)
    common = np.zeros(theta.P)
    common[known] = inverse @ rhs[known]
    bodies = []
    for k in loaded:
        own, side = theta.data_information(found[k].A, weights)
        alone = np.asarray(
            np.linalg.inv(own[hand, hand] + np.diag(1.0 / PRIOR_STD**2)), dtype=float
        )
        body: Array = alone @ (side[hand] - own[hand] @ common)
        bodies.append(Body(body, alone, _gain(own, hand), inverse))
    return bodies


def _gain(information: Array, hand: slice) -> Array:
    """(10, P) how a body at the hand follows all else in a recording."""
    prior = np.diag(1.0 / PRIOR_STD**2)
    return np.asarray(np.linalg.solve(information[hand, hand] + prior, information[hand]))


def _of_logs(
    learner: OnlineLearner,
    found: Sequence[LogMoments],
    used: Sequence[LogMoments],
    loads: Mapping[str, tuple[Array, float]],
) -> tuple[OfLog, ...]:
    theta, among = learner.theta, {x.content for x in used}
    H, _ = theta.information()
    known = theta.known()
    before = np.linalg.slogdet(H[np.ix_(known, known)])[1]
    weights, told = theta.weights(), []
    for log in found:
        load = loads.get(log.content)
        A = _without(theta, log.A, None if load is None else load[0])
        information, side = theta.data_information(A, weights)
        best = theta.th.copy()
        alone = (information + theta.prior)[np.ix_(known, known)]
        best[known] = np.linalg.solve(alone, (side + theta.prior_rhs)[known])
        rmse, own_rmse = (
            np.sqrt(np.maximum(theta.costs(x, A), 0.0) / log.count) for x in (theta.th, best)
        )
        more = (H + information)[np.ix_(known, known)]
        worth = 0.5 * float(np.linalg.slogdet(more)[1] - before) / len(known)
        effects, std = _own_effects(theta, information, side, rmse)
        carried = None if load is None else Load(float(load[0][0]), load[1])
        own = carried, effects, std, rmse, own_rmse
        told.append(OfLog(log, log.content in among, *own, (), worth))
    usual = np.median([x.rmse for x in told if x.used], axis=0)
    few = len(told) < FEWEST_TO_COMPARE
    out = [x if few else replace(x, disagrees=_worse(x, usual, len(told))) for x in told]
    return tuple(sorted(out, key=lambda x: (x.moments.begin_s, x.moments.path)))


def _worse(log: OfLog, usual: Array, logs: int) -> tuple[int, ...]:
    """Joints (from 1) that the arm's model fits worse than is usual, than could be, than chance."""
    least = np.maximum(usual, log.own_rmse)
    count = max(log.moments.count, 1.0)
    chance = chi2.sf(count * np.square(log.rmse / np.maximum(least, TINY)), count)
    worse = (log.rmse > 1.5 * least) & (chance * logs * len(usual) < CHANCE)
    return tuple(int(j) + 1 for j in np.flatnonzero(worse))


def _own_effects(theta: Theta, information: Array, side: Array, rmse: Array) -> tuple[Array, Array]:
    """(e, n) effects in one recording, the bodies being the arm's, and standard deviations."""
    shape = theta.effect_values.shape
    at = np.arange(theta.P - theta.effect_values.size, theta.P)
    bodies = np.arange(at[0]) if len(at) else np.arange(theta.P)
    spread = (theta.effect_spread[:, None] * theta.drums).ravel()
    own = information[np.ix_(at, at)] + np.diag(1.0 / spread**2)
    right = side[at] - information[np.ix_(at, bodies)] @ theta.th[bodies]
    found = np.linalg.solve(own, right + theta.th[at] / spread**2)
    worse = np.maximum(1.0, rmse / np.sqrt(theta.variance()))
    std = np.sqrt(np.diagonal(np.linalg.inv(own))).reshape(shape) * worse
    return found.reshape(shape), std


def _series(logs: Sequence[OfLog], effects: Sequence[str]) -> list[Series]:
    """Effects joint by joint over an arm's recordings."""
    values, std = (np.array([getattr(x, key) for x in logs]) for key in ("effects", "effects_std"))
    values[[not x.used for x in logs]] = np.nan
    places = [(k, j) for k in range(len(effects)) for j in range(values.shape[2])]
    return [Series(effects[k], j + 1, values[:, k, j], std[:, k, j]) for k, j in places]


def _columns(logs: Sequence[OfLog], told: Mapping[str, Mapping[str, float]]) -> dict[str, Array]:
    """What parameters may follow: time, and what the manifest tells of these recordings."""
    begin_s = np.array([x.moments.begin_s for x in logs])
    if begin_s.max() >= EPOCH_S:  # beside dates another clock's stamp is none
        begin_s[begin_s < EPOCH_S] = np.nan
    columns: dict[str, Array] = {TIME: (begin_s - np.nanmin(begin_s)) / DAY_S}
    own = [told.get(x.moments.content, {}) for x in logs]
    for name in sorted({key for row in own for key in row} - {TIME}):
        columns[name] = np.array([row.get(name, np.nan) for row in own])
    return columns
