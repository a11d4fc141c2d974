"""One arm from the moments of its recordings: its model, and what each recording tells beside it.

Inertias, friction and offsets are common. A recording whose hand is heavier or lighter than is
usual on this arm (the median) carries a body of its own, which is solved for with all else and
taken off its moments. λ is the documented one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from adapter.effects.catalogue import effects_by_name
from adapter.learning.learner import OnlineLearner
from adapter.learning.theta import PRIOR_STD, Theta
from adapter.learning.theta_kernels import Moments
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.runs.fleet.moments import LogMoments, effects_for, learner_of
from adapter.runs.outcome import Outcome, collect, learned_model

FITS = 6  # of weights and priors to what was found with those before
LOAD_ROUNDS = 4  # of loads to weights
LEAST_LOAD_KG, LOAD_STD = 0.05, 4.0  # less than this, or so many standard deviations, is no load
TIMES_WORSE = 1.5  # than its own best fit and than other logs: one that disagrees
FEWEST_TO_COMPARE, FEWEST_FOR_DRIFT = 3, 5  # logs
# that a line through what does not change is as steep: by standard deviations, and by scatter alone
CHANCE, CHANCE_BY_SCATTER = 1e-5, 0.01
DAY_S = 86_400.0
TIME = "time"  # the covariate that every log has


class Load(NamedTuple):
    """What a recording's hand carries more than is usual, kg, and its standard deviation."""

    mass: float
    std: float


class Drift(NamedTuple):
    """A parameter that follows something.

    Attributes:
        effect, joint: of which joint (from 1).
        follows: "time", or a column of the manifest.
        slope, std: of the parameter per day, or per unit of the column.
        span: how far the parameter goes over all recordings.
    """

    effect: str
    joint: int
    follows: str
    slope: float
    std: float
    span: float


@dataclass(frozen=True, eq=False)
class OfLog:
    """What one recording tells beside the arm's model.

    Attributes:
        moments: of the recording, as they were taken.
        load: None where the hand is as usual.
        effects, effects_std: (e, n) of this recording alone, inertias being the arm's.
        rmse, own_rmse: (n,) N m of the arm's model, and of the best one for this recording alone.
        disagrees: joints (from 1) that the arm's model fits much worse than that one, and than it
            fits other recordings.
        worth: information that the same motion once more would add, nats per parameter.
    """

    moments: LogMoments
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
        model: learned from all recordings.
        outcome: of the learner, for whatever reads those.
        solution, std: (P,) (θ, effects) and standard deviations, before bodies are made possible.
        effects: names of what was learned beside θ.
        logs: in the order of their begin.
        drifts: the surest first.
    """

    name: str
    model: SelfModel
    outcome: Outcome
    solution: Array
    std: Array
    effects: tuple[str, ...]
    logs: tuple[OfLog, ...]
    drifts: tuple[Drift, ...]


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
    learner = learner_of(documented)
    theta = learner.theta
    _pool(theta, found, {})
    loads: dict[str, tuple[Array, float]] = {}
    for _ in range(LOAD_ROUNDS if len(found) >= FEWEST_TO_COMPARE else 0):
        loads = _loads(theta, found)
        _pool(theta, found, {key: phi for key, (phi, _) in loads.items()})
    begin = min(x.begin_s for x in found)
    learner.start_theta(round(1e9 * begin))
    learner.learned = sum(x.samples for x in found)
    logs = _of_logs(learner, found, loads)
    outcome = collect(learner)
    model = learned_model(outcome, documented, fleet=[x.path for x in found])
    solution, std = theta.th.copy(), np.sqrt(np.diagonal(theta.covariance()))
    effects = effects_for(documented)
    drifts = _drifts(logs, effects, told or {})
    return FleetArm(name, model, outcome, solution, std, effects, logs, drifts)


def _pool(theta: Theta, found: Sequence[LogMoments], loads: Mapping[str, Array]) -> None:
    """Put the sum of all moments in place, loads taken off, and solve for (θ, effects)."""
    A, count = np.zeros_like(theta.moments.A), 0.0
    for log in found:
        A += _without(theta, log.A, loads.get(log.content))
        count += log.count
    theta.replace_moments(Moments(A, theta.moments.C, *theta.moments[2:]), count)
    for _ in range(FITS):
        theta.th[:] = theta.least_squares()
        theta.adapt_prior()
    theta.th[:] = theta.least_squares()


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
    weights = theta.weights()
    own = [theta.data_information(log.A, weights) for log in found]
    every = _solved(theta, own, range(len(found)))
    masses = np.array([x.body[0] for x in every])
    usual = every[np.argsort(masses)[len(masses) // 2]]
    std = np.array([_mass_std(theta, x, usual) for x in every])
    beyond = np.abs(masses - usual.body[0]) > np.maximum(LEAST_LOAD_KG, LOAD_STD * std)
    loaded = [k for k, x in enumerate(beyond) if x]
    again = _solved(theta, own, loaded)
    return {
        found[k].content: (x.body, _mass_std(theta, x, None))
        for k, x in zip(loaded, again, strict=True)
    }


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


def _solved(theta: Theta, own: Sequence[tuple[Array, Array]], loaded: Sequence[int]) -> list[Body]:
    """Bodies at the hands of `loaded`, the arm's θ being common.

    A body acts as the hand does; it is eliminated from the information of its recording, and found
    when all others have said what the arm is (Schur complement).
    """
    H, rhs, hand = theta.prior.copy(), theta.prior_rhs.copy(), theta.hand
    for k, (information, side) in enumerate(own):
        H += information
        rhs += side
        if k in loaded:
            gain = _gain(information, hand)
            H -= information[:, hand] @ gain
            rhs -= gain.T @ side[hand]
    known = theta.known()
    inverse = np.asarray(np.linalg.inv(H[np.ix_(known, known)]), dtype=float)
    common = np.zeros(theta.P)
    common[known] = inverse @ rhs[known]
    found = []
    for information, side in (own[k] for k in loaded):
        alone = np.asarray(
            np.linalg.inv(information[hand, hand] + np.diag(1.0 / PRIOR_STD**2)), dtype=float
        )
        body: Array = alone @ (side[hand] - information[hand] @ common)
        found.append(Body(body, alone, _gain(information, hand), inverse))
    return found


def _gain(information: Array, hand: slice) -> Array:
    """(10, P) how a body at the hand follows all else in a recording."""
    prior = np.diag(1.0 / PRIOR_STD**2)
    return np.asarray(np.linalg.solve(information[hand, hand] + prior, information[hand]))


def _of_logs(
    learner: OnlineLearner,
    found: Sequence[LogMoments],
    loads: Mapping[str, tuple[Array, float]],
) -> tuple[OfLog, ...]:
    theta = learner.theta
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
        worth = float(np.linalg.slogdet(more)[1] - before) / len(known)
        effects, std = _own_effects(theta, information, side, rmse)
        carried = None if load is None else Load(float(load[0][0]), load[1])
        told.append(OfLog(log, carried, effects, std, rmse, own_rmse, (), worth))
    usual = np.median([x.rmse for x in told], axis=0)
    out = [
        replace(x, disagrees=_worse(x, usual) if len(told) >= FEWEST_TO_COMPARE else ())
        for x in told
    ]
    return tuple(sorted(out, key=lambda x: (x.moments.begin_s, x.moments.path)))


def _worse(log: OfLog, usual: Array) -> tuple[int, ...]:
    """Joints (from 1) that the arm's model fits worse than is usual, and than could be."""
    worse = log.rmse > TIMES_WORSE * np.maximum(usual, log.own_rmse)
    return tuple(int(j) + 1 for j in np.flatnonzero(worse))


def _own_effects(theta: Theta, information: Array, side: Array, rmse: Array) -> tuple[Array, Array]:
    """(e, n) effects in one recording, the bodies being the arm's, and standard deviations."""
    shape = theta.effect_values.shape
    at = np.arange(theta.P - theta.effect_values.size, theta.P)
    bodies = np.arange(at[0]) if len(at) else np.arange(theta.P)
    spread = np.repeat(theta.effect_spread, theta.tree.n)
    own = information[np.ix_(at, at)] + np.diag(1.0 / spread**2)
    right = side[at] - information[np.ix_(at, bodies)] @ theta.th[bodies]
    found = np.linalg.solve(own, right + theta.th[at] / spread**2)
    worse = np.maximum(1.0, rmse / np.sqrt(theta.variance()))
    std = np.sqrt(np.diagonal(np.linalg.inv(own))).reshape(shape) * worse
    return found.reshape(shape), std


def _drifts(
    logs: Sequence[OfLog], effects: Sequence[str], told: Mapping[str, Mapping[str, float]]
) -> tuple[Drift, ...]:
    """Parameters that follow time or a column of the manifest."""
    begin_s = np.array([x.moments.begin_s for x in logs])
    columns = {TIME: (begin_s - begin_s.min()) / DAY_S}
    for name in sorted({key for row in told.values() for key in row}):
        columns[name] = np.array([told.get(x.moments.content, {}).get(name, np.nan) for x in logs])
    found: list[tuple[float, Drift]] = []
    for name, x in columns.items():
        for k, effect in enumerate(effects_by_name(effects)):
            for j in range(logs[0].effects.shape[1]):
                y, std = (
                    np.array([getattr(log, key)[k, j] for log in logs])
                    for key in ("effects", "effects_std")
                )
                line = _line(x, y, std)
                if (
                    line is not None
                    and line.chance < CHANCE
                    and line.by_scatter < CHANCE_BY_SCATTER
                ):
                    span = abs(line.slope) * float(np.nanmax(x) - np.nanmin(x))
                    drift = Drift(effect.name, j + 1, name, line.slope, line.std, span)
                    found.append((line.chance, drift))
    return tuple(drift for _, drift in sorted(found, key=lambda x: x[0]))


class Line(NamedTuple):
    """A line's slope and its standard deviation.

    Attributes:
        chance: that no slope looks like it, by the numbers' own standard deviations (or their
            scatter, where that is larger); by_scatter: by their scatter alone.
    """

    slope: float
    std: float
    chance: float
    by_scatter: float


def _line(x: Array, y: Array, std: Array) -> Line | None:
    """The line through y (m,) over x (m,); None where too few numbers say anything."""
    use = np.isfinite(x) & np.isfinite(y) & (std > 0.0)
    if use.sum() < FEWEST_FOR_DRIFT or np.ptp(x[use]) <= 0.0:
        return None
    x, y, weight = x[use], y[use], 1.0 / std[use] ** 2
    middle = np.sum(weight * x) / np.sum(weight)
    spread = float(np.sum(weight * (x - middle) ** 2))
    slope = float(np.sum(weight * (x - middle) * y) / spread)
    level = np.sum(weight * y) / np.sum(weight)
    left = float(np.sum(weight * (y - level - slope * (x - middle)) ** 2)) / (len(x) - 2)
    std_slope, scattered = (float(np.sqrt(k / spread)) for k in (max(1.0, left), left))
    by_scatter = float(2.0 * student.sf(abs(slope) / max(scattered, 1e-300), len(x) - 2))
    return Line(slope, std_slope, float(2.0 * norm.sf(abs(slope) / std_slope)), by_scatter)
