"""The figures of a run: the JSON of `run` and `replay`, and the numbers in the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from adapter.effects.active import SHOWN_STD, with_bodies
from adapter.effects.by_joint import WAYS_RAD, JointSignals
from adapter.effects.catalogue import effects_by_name
from adapter.errors import ModelError
from adapter.model.model_file import load_model
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, matrix_from_zxz, zxz_from_matrix
from adapter.physics.freedom import Freedom, slid_to
from adapter.physics.identifiability import frame_observability
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.outcome import (
    TORQUE_GOAL,
    Outcome,
    changes_at,
    completed_lambda,
    frame_errors,
    told_load,
    told_parameters,
)
from drivers.files.bounded import parse_json, read_text

ROTATION_GOAL_RAD, POSITION_GOAL_M = 0.01, 0.005
TORQUE_WINDOW_S = 2.0


@dataclass(frozen=True)
class Reference:
    """What λ is compared with.

    Attributes:
        lam: (n, 6); theta: (n, 10), None where not known.
        source: "documentation", or the file it was read from.
        truth: what a scenario's file tells, for the page; None of anything else.
    """

    lam: Array
    theta: Array | None
    source: str
    truth: Mapping[str, Any] | None = None


def reference_from(path: str | Path | None, documented: SelfModel) -> Reference:
    """The truth of a scenario or a model file; the documentation where no path is given.

    Raises:
        ModelError: the file cannot be read, or describes another number of joints.
    """
    n = documented.tree.n
    if path is None:
        return Reference(documented.lam, documented.theta[-n:], "documentation")
    try:
        content = parse_json(read_text(path))
    except (OSError, ValueError) as error:
        raise ModelError(f"{path}: cannot be read as a truth or model file: {error}") from error
    if not isinstance(content, dict) or "lambda" not in content:
        raise ModelError(f"{path}: has no 'lambda'; give a scenario's truth or a model file")
    truth: Mapping[str, Any] | None = None
    if content.get("format") == "panda-adapter/self-model":
        model = load_model(path)
        lam, theta = model.lam, model.theta[-n:]
    else:
        lam = np.array(content["lambda"], dtype=float)
        theta = np.array(content.get("theta", []), dtype=float)
        whole = content.keys() >= {"theta", "effects", "gravity"}
        truth = content if whole and content.get("format") == "panda-adapter/truth" else None
    if lam.shape != (n, 6):
        raise ModelError(f"{path}: describes {len(lam)} joints, the robot has {n}")
    return Reference(lam, theta if theta.shape == (n, 10) else None, str(path), truth)


def stamps_s(rows: Array) -> Array:
    """Stamps (k,) in s of trace rows, whose first column is the stamp in ns."""
    return 1e-9 * rows[:, 0]


def settled_at(times: Array, good: Any) -> float | None:
    """The time after which `good` always holds; None where it does not hold at the end."""
    if not len(times) or not good[-1]:
        return None
    bad = np.flatnonzero(~good)
    return float(times[bad[-1] + 1] if len(bad) else times[0])


def _since(start_s: float | None, at_s: float | None) -> float | None:
    """Seconds from the start; 0 for what was reached before it, in a slow phase, say."""
    return None if start_s is None or at_s is None else max(at_s - start_s, 0.0)


def counted_from(figures: Mapping[str, Any]) -> str:
    """What times of convergence count from, in words."""
    return "the slow phase" if figures.get("slow_s") else "the first motion"


def course_errors(
    outcome: Outcome, documented: SelfModel, reference: Reference
) -> tuple[Array, Array]:
    """Rotation, rad, and position, m, errors (k, n) of λ on its way (rows of `schema_trace`).

    Measured in what the data had shown by then: of the directions that they show at last the
    clearest, as many as were known.
    """
    n = documented.tree.n
    seen = frame_observability(documented.tree, reference.lam, documented.gravity)
    lam = outcome.schema_trace[:, 1:].reshape(-1, n, 6)
    out = np.zeros((2, len(lam), n))
    for j in range(n):
        known, one = outcome.schema_known[:, j], slice(j, j + 1)
        _, clearest = np.linalg.eigh(outcome.lam_information[j])
        for rank in np.unique(known).astype(int):
            freedom = seen.freedom.joint(j)
            if rank < seen.ranks[j]:
                hidden = clearest[:, : 6 - rank]
                freedom = Freedom.of((hidden @ hidden.T)[None], outcome.lam[one, 3:])
            rows = known == rank
            errors = frame_errors(lam[rows, one], reference.lam[one], freedom)
            out[0, rows, j], out[1, rows, j] = errors[0][:, 0], errors[1][:, 0]
    return out[0], out[1]


def schema_score(
    outcome: Outcome, documented: SelfModel, reference: Reference, start_s: float | None
) -> dict[str, Any]:
    """The `lambda` part of the figures; errors per joint in what the data show.

    λ has converged when the learner has said so and its errors are inside both goals, for good.
    """
    lam, filled = completed_lambda(outcome, documented)
    if outcome.settings.schema.imus:
        # with its links' frames, along and about their axes, where λ has them
        ours, theirs = ((matrix_from_zxz(x[:, :3]), x[:, 3:]) for x in (lam, reference.lam))
        R, p = slid_to(documented.tree, documented.gravity, theirs, ours)
        reference = replace(reference, lam=np.concatenate([zxz_from_matrix(R), p], axis=1))
    seen = frame_observability(documented.tree, reference.lam, documented.gravity)
    turn, shift = course_errors(outcome, documented, reference)
    inside = (turn < ROTATION_GOAL_RAD).all(axis=1) & (shift < POSITION_GOAL_M).all(axis=1)
    inside &= np.maximum.accumulate(outcome.schema_known[:, -1] > 0.0)
    at = settled_at(stamps_s(outcome.schema_trace), inside)
    hidden = np.eye(6) - outcome.lam_identifiable
    freedom = Freedom.of(hidden, outcome.lam[:, 3:])
    last_turn, last_shift = frame_errors(lam, reference.lam, freedom)
    spread = np.sqrt(np.maximum(np.einsum("jaa->ja", outcome.lam_covariance), 0.0))
    return {
        "converged_s": _since(start_s, at) if outcome.verdict.good else None,
        "rotation_error_rad": last_turn.tolist(),
        "position_error_m": last_shift.tolist(),
        "identifiable_rank": outcome.lam_rank,
        "observable_rank": seen.rank,
        "std": {
            "rotation_rad": _shown(np.linalg.norm(spread[:, :3], axis=1)),
            "position_m": _shown(np.linalg.norm(spread[:, 3:], axis=1)),
        },
        "settled": outcome.lam_converged,
        "source": "measured" if outcome.lam_measured else "reproduces the documentation",
        "reference": reference.source,
        "values": lam.tolist(),
        "filled": filled,
        "restarts": outcome.lam_restarts,
    }


def _shown(std: Array) -> list[float | None]:
    """(n,) with None for joints of which no motion shows anything."""
    return [x if x > 0.0 else None for x in std.tolist()]


class ScoreRows:
    """The states kept for scoring, with the torque any parameters predict for them."""

    def __init__(self, outcome: Outcome, documented: SelfModel) -> None:
        n = self.n = documented.tree.n
        rows = outcome.score_trace
        self.time_s = stamps_s(rows)
        self.q, self.dq, self.ddq, self.tau, self.error = (
            np.ascontiguousarray(rows[:, 1 + k * n : 1 + (k + 1) * n]) for k in range(5)
        )
        memory = len(rows[0]) - (len(WAYS_RAD) + 2) * n
        self._base = rows[:, 1 + 5 * n : memory] if documented.tree.floating else None
        self._memory = rows[:, memory:].reshape(len(rows), -1, n).swapaxes(0, 1)
        self._outcome, self._documented = outcome, with_bodies(documented)
        first = outcome.changes_ns[0] if outcome.changes_ns else np.inf
        self.before_change = rows[:, 0] < first
        last = outcome.changes_ns[-1] if outcome.changes_ns else -np.inf
        self.after_changes = rows[:, 0] >= last

    def batch_torque(self) -> Array:
        """(k, n) torque of the final batch least squares."""
        best, bodies = self._outcome.least_squares, self._documented.tree.bodies
        effects = best[10 * (bodies + 1) :].reshape(-1, self.n)
        return self.torque(best[: 10 * bodies].reshape(bodies, 10), effects)

    def torque(self, theta: Array, effects: Array) -> Array:
        """(k, n) torque of θ (bodies, 10) and effect parameters (e, n), with the learned frames."""
        learned = replace(self._documented, lam=self._outcome.lam, theta=theta)
        arm = RigidArm.of(learned)
        arm = arm if self._base is None else arm.moving(self._base)
        tau = arm.torque(self.q, self.dq, self.ddq)
        bent, rates = self._memory[:-2], self._memory[-2:]
        smoothing_s = self._outcome.smoothing_s
        at = JointSignals(self.q, self.dq, self.ddq, self.tau, smoothing_s, bent, rates)
        known = effects_by_name(self._outcome.settings.effects)
        for gain, effect, shape in zip(effects, known, self._outcome.shapes, strict=True):
            tau += gain * effect.torque_per_unit(at, shape)
        return tau


def trailing_rms(time_s: Array, error: Array, window_s: float) -> Array:
    """(k,) root of the mean of |error (k, n)|² over the window that ends at each row."""
    total = np.concatenate([[0.0], np.cumsum((error**2).sum(axis=1))])
    first = np.searchsorted(time_s, time_s - window_s, side="left")
    k = np.arange(len(time_s))
    return np.sqrt((total[k + 1] - total[first]) / (k + 1 - first))


def theta_score(outcome: Outcome, documented: SelfModel, start_s: float | None) -> dict[str, Any]:
    """The `theta` part of the figures.

    Convergence is judged up to the first change at the hand: prequential torque error against
    the batch solution's on the same samples, joints in units of their noise.
    """
    held = told_load(outcome.held)
    score: dict[str, Any] = {
        "converged_s": None,
        "settled": outcome.theta_settled,
        "excess": outcome.theta_excess,
        "base_parameters": told_parameters(outcome, documented).rank,
        "torque_rmse_nm": [],
        "validation_torque_rmse_nm": None,
        "min_pseudo_inertia_eigenvalue": outcome.min_eigenvalue,
        "effects": {
            effect.name: outcome.effects[k].tolist()
            for k, effect in enumerate(effects_by_name(outcome.settings.effects))
        },
        "changes": changes_at(outcome.changes_ns, outcome.payload, outcome.disagreements),
        "held": held if held["m"] > SHOWN_STD * held["m_std"] else None,
        "rebuilds": outcome.rebuilds,
        "started_s": None,
        "values": outcome.theta.tolist(),
    }
    if outcome.theta_started_ns is None or not len(outcome.score_trace):
        return score
    score["started_s"] = _since(start_s, 1e-9 * outcome.theta_started_ns)
    rows = ScoreRows(outcome, documented)
    late = rows.after_changes
    final = rows.tau - rows.torque(outcome.theta, outcome.effects)
    score["torque_rmse_nm"] = np.sqrt(np.mean(final[late] ** 2, axis=0)).tolist()
    batch = rows.tau - rows.batch_torque()
    noise = np.sqrt(outcome.variance)
    early = rows.before_change
    ours = trailing_rms(rows.time_s[early], rows.error[early] / noise, TORQUE_WINDOW_S)
    theirs = trailing_rms(rows.time_s[early], batch[early] / noise, TORQUE_WINDOW_S)
    at = settled_at(rows.time_s[early], ours <= TORQUE_GOAL * theirs)
    score["converged_s"] = _since(start_s, at) if outcome.verdict.good else None
    return score


class Course(NamedTuple):
    """How a run or a replay went.

    Attributes:
        samples: taken by the front end.
        refused: counts by reason.
        first_moving_ns: stamp of the first moving sample, None where nothing moved.
        delay_s: from a filtered stamp to the sample that completed it.
        tick_us: percentiles of the tick, by name; None where there was no tick.
        missed_deadlines: ticks that came too late.
        slow_s: how long the motion was slow at first.
    """

    samples: int
    refused: Mapping[str, int]
    first_moving_ns: int | None
    delay_s: float
    tick_us: Mapping[str, float | None] = MappingProxyType({})
    missed_deadlines: int = 0
    slow_s: float = 0.0


def figures(
    outcome: Outcome, documented: SelfModel, reference: Reference, course: Course, **more: Any
) -> dict[str, Any]:
    """The figures of `run` and `replay`.

    Times of convergence count from the first moving sample, or the end of the slow phase, and are
    0 where it was reached before.

    Filtered stamps lie `delay_s` before the sample that completed them; an estimate is there
    when its sample is, so the delay is added to every time of convergence.
    """
    first_ns = course.first_moving_ns
    start_s = None if first_ns is None else 1e-9 * first_ns - course.delay_s + course.slow_s
    return {
        "samples": course.samples,
        "learned": outcome.learned,
        "refused": {reason: int(count) for reason, count in course.refused.items() if count},
        "missed_deadlines": course.missed_deadlines,
        "tick_us": dict(course.tick_us),
        "slow_s": course.slow_s,
        "lambda": schema_score(outcome, documented, reference, start_s),
        "theta": theta_score(outcome, documented, start_s),
        "torques": {"judged": outcome.verdict.judged, "refusal": outcome.verdict.refusal},
        "disagreements": None if outcome.disagreements is None else list(outcome.disagreements),
        **({} if reference.truth is None else {"truth": dict(reference.truth)}),
        **more,
    }
