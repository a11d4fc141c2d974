"""What a learner has to say at the end of a run, apart from the learner itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adapter.effects.active import active_effects, with_bodies
from adapter.effects.base import LearnedEffect
from adapter.effects.catalogue import KNOWN, effects_by_name
from adapter.errors import ModelError
from adapter.learning.batch.theta_filling import (
    filled_theta,
    filled_words,
    possible_theta,
    told_basis,
)
from adapter.learning.frame_fit import Frame, nearest, profiled_weights
from adapter.learning.known_effects import NOT_THERE
from adapter.learning.learner import NOT_ASKED, OnlineLearner, TorqueVerdict
from adapter.learning.posterior import Load
from adapter.learning.settings import LearnerSettings
from adapter.model.inertia import body_from_theta, min_eigenvalue
from adapter.model.posterior import Posterior, room_of, root_of
from adapter.model.self_model import LAMBDA_MEASURED, LAMBDA_REPRODUCED, SelfModel
from adapter.model.spatial import Array, log_rotation, matrix_from_zxz, zxz_from_matrix
from adapter.model.tree import Tree
from adapter.physics.freedom import Freedom
from adapter.physics.identifiability import SHOWN_ALONE, BaseParameters, random_regressor
from adapter.signals.records import LinkMotionKind

TORQUE_GOAL = 1.1  # times the final batch least squares
SAME_LOAD_S = 2.0  # a load that learner and watch date so near each other is one


@dataclass(frozen=True)
class Outcome:
    """Everything a report, a model file or a score needs; plain arrays, so that it can travel.

    Attributes:
        learned: states learned from.
        start_lam, lam: (n, 6) λ at first and at last.
        lam_covariance, lam_identifiable: (n, 6, 6) of (turn, shift) in the parents' axes.
        lam_rank, lam_converged, lam_measured: directions shown; settled; learned from sensors.
        lam_restarts: joints that λ was started anew for, out of a wrong valley.
        lam_notes: what is wrong with sensors on links, a sentence each.
        lam_moments: (n, 3, 15, 15) that λ was learned from, of lam_count samples.
        theta: (bodies, 10) as learned, the base first if it floats, with these effects.
        effects, effects_std: (e, n) as the posterior has them.
        shapes: (e, n) of the effects that have several (`LearnedEffect`), NaN for the others.
        variance: (n,) of the residual torque, (N m)².
        theta_started_ns: stamp of the first state θ learned from, None before.
        theta_excess: torque error of θ over that of batch least squares on the same data, rms over
            the joints; theta_settled: it is inside the goal, or the learner says so.
        theta_information: (10 bodies, 10 bodies) that data have on θ, see `Theta.told_by_data`.
        covariance: (10 bodies, 10 bodies) of θ, see `LearnedPosterior`.
        joint_covariance: (10 n + e n, 10 n + e n) of the links' θ and the effects, see there.
        least_squares: (P,) of the learner's flat parameters.
        held: (theta (10,), covariance (10, 10)) of what the hand carries from the first sample on,
            beside the documented arm; payload: since a change.
        schema_trace: rows [stamp ns, λ]; theta_trace: rows [stamp ns, θ and effects].
        schema_known: (k, n + 1) of the rows of schema_trace: directions known by joint, and
            whether λ was said to have converged. lam_information: (n, 6, 6) at last.
        score_trace: rows [stamp ns, q, dq, ddq, tau, torque error before learning], and behind
            them the motion (12,) of a base that floats, then how far bristles are bent and rates of
            the torque (`StateLayout.memory`).
        frames: (R0, p) that θ's moments were taken with.
        smoothing_s: how long the filter takes a step of torque.
        min_eigenvalue: smallest eigenvalue of any link's pseudo-inertia at any traced step.
        disagreements: what `adapter.gap.monitor` reported; None where nothing watched.
        verdict: on the torques; where it is not good, nothing has converged.
    """

    learned: int
    start_lam: Array
    lam: Array
    lam_covariance: Array
    lam_identifiable: Array
    lam_rank: int
    lam_converged: bool
    lam_measured: bool
    lam_restarts: int
    lam_notes: tuple[str, ...]
    lam_moments: Array
    lam_count: float
    theta: Array
    effects: Array
    effects_std: Array
    shapes: Array
    variance: Array
    theta_started_ns: int | None
    theta_excess: float
    theta_settled: bool
    theta_information: Array
    covariance: Array
    joint_covariance: Array
    least_squares: Array
    held: Load
    payload: Load | None
    changes_ns: tuple[int, ...]
    rebuilds: int
    schema_trace: Array
    schema_known: Array
    lam_information: Array
    theta_trace: Array
    score_trace: Array
    min_eigenvalue: float
    settings: LearnerSettings
    smoothing_s: float
    disagreements: tuple[dict[str, Any], ...] | None = None
    verdict: TorqueVerdict = NOT_ASKED


def in_parents(R0: Array, table: Array) -> Array:
    """Tables (n, 6, 6) of (phi, d) as of (turn in the parent's axes, d); R0 (n, 3, 3)."""
    to_parent = np.zeros(table.shape)
    to_parent[:, :3, :3], to_parent[:, 3:, 3:] = R0, np.eye(3)
    return np.asarray(to_parent @ table @ to_parent.transpose(0, 2, 1))


def collect(learner: OnlineLearner) -> Outcome:
    """Read off a learner what there is to tell."""
    schema, theta = learner.schema, learner.theta
    traced = learner.theta_trace.rows[:, 1 : 1 + 10 * learner.tree.bodies].reshape(-1, 10)
    eigenvalues = min_eigenvalue(np.concatenate([traced, theta.theta]))
    batch, started = theta.least_squares(), learner.theta_started_ns is not None
    excess = float(np.sqrt(np.mean(theta.variance() / theta.variance(batch))))
    known = learner.posterior()
    bodies, information = theta.theta_given(known.effects)
    # λ's course: the learner keeps frames, since reading λ off them takes longer
    n, rows = learner.tree.n, learner.schema_trace.rows
    angles = zxz_from_matrix(rows[:, 1 : 1 + 9 * n].reshape(-1, n, 3, 3))
    lam = np.concatenate([angles, rows[:, 1 + 9 * n : 1 + 12 * n].reshape(-1, n, 3)], axis=2)
    course = np.concatenate([rows[:, :1], lam.reshape(len(rows), 6 * n)], axis=1)
    return Outcome(
        learned=learner.learned,
        start_lam=schema.start_lam,
        lam=schema.lam,
        lam_covariance=in_parents(schema.R0, schema.covariance()),
        lam_identifiable=in_parents(schema.R0, schema.certain),
        lam_rank=round(float(np.einsum("jaa->", schema.certain))),
        lam_converged=schema.converged and learner.verdict.good,
        lam_measured=schema.kind == LinkMotionKind.MEASURED,
        lam_restarts=schema.check.restarts,
        lam_notes=tuple(schema.notes),
        lam_moments=schema.moments.M.copy(),
        lam_count=schema.count,
        theta=possible_theta(bodies, theta.theta, information),
        effects=known.effects,
        effects_std=known.std,
        shapes=theta.shapes.copy(),
        variance=theta.variance(),
        theta_started_ns=learner.theta_started_ns,
        theta_excess=excess,
        theta_settled=started and (learner.theta_converged or excess <= TORQUE_GOAL),
        theta_information=theta.told_by_data(),
        covariance=known.covariance,
        joint_covariance=known.joint,
        least_squares=batch,
        held=known.held,
        payload=known.payload,
        changes_ns=tuple(learner.changes),
        rebuilds=learner.rebuilds,
        schema_trace=course,
        schema_known=learner.schema_trace.rows[:, 1 + 12 * learner.tree.n :].copy(),
        lam_information=in_parents(schema.R0, schema.information),
        theta_trace=learner.theta_trace.rows.copy(),
        score_trace=learner.score_trace.rows.copy(),
        min_eigenvalue=float(np.min(eigenvalues)),
        settings=learner.settings,
        smoothing_s=theta.smoothing_s,
        disagreements=None if learner.watch is None else tuple(learner.watch.reports),
        verdict=learner.verdict,
    )


def completed_lambda(outcome: Outcome, documented: SelfModel) -> tuple[Array, list[str]]:
    """The learned λ with what no data showed taken from the documentation, by a finite motion.

    Torques stay what they were with θ as it is: what changes no link's motion changes no torque
    (virtual work).

    Returns:
        (n, 6), of all that explain the data as the learned one does the nearest to the documented
        one; and a sentence by joint on what of it the documentation says.
    """
    R, p = matrix_from_zxz(outcome.lam[:, :3]), outcome.lam[:, 3:]
    told = matrix_from_zxz(documented.lam[:, :3]), documented.lam[:, 3:]
    freedom = Freedom.of(np.eye(6) - outcome.lam_identifiable, p)
    if outcome.settings.schema.imus:  # began at the documentation, and stayed where none is shown
        return outcome.lam, freedom.words(documented.tree)
    moved = freedom.nearest(R, p, *told)
    found = [Frame(*x) for x in zip(*moved, strict=True)]
    if outcome.lam_converged:  # else what moments say is not what was learned
        for j, (sums, frame) in enumerate(zip(outcome.lam_moments, found, strict=True)):
            weights = profiled_weights(sums, outcome.lam_count, Frame(R[j], p[j]))
            to = Frame(told[0][j], told[1][j])
            found[j] = nearest(sums, weights, frame, to, freedom.joint(j))
    lam = np.array([np.r_[zxz_from_matrix(frame.R0), frame.p] for frame in found])
    return lam, freedom.words(documented.tree)


def completed_theta(
    outcome: Outcome, documented: SelfModel, lam: Array, basis: Array
) -> tuple[Array, dict[str, Any]]:
    """The learned θ (bodies, 10) with what torques did not show taken from the documentation.

    Torques over the motion that was learned from stay what they were but for noise, unless no
    possible bodies have them.

    Args:
        lam: (n, 6) λ as it leaves the house; basis: of what data told, see `told_parameters`.

    Returns:
        θ, and what is to be said of it, for the model's provenance.
    """
    if outcome.theta_started_ns is None:
        said = {"theta_source": "documentation: λ had not converged", "theta_converged": False}
        return documented.theta, said
    size = documented.theta.size
    wrench, count = outcome.settings.base_wrench, 4 * size
    _, table = random_regressor(documented.tree, lam, documented.gravity, count, wrench=wrench)
    table, notes = table.reshape(-1, size), []
    said = {"theta_source": "learned", "theta_converged": outcome.theta_settled}
    if not outcome.theta_settled:
        notes = [
            f"it had not converged: its torque error is {outcome.theta_excess:.3g} times that of "
            "batch least squares on the same data; it takes more motion to learn from"
        ]
    theta = outcome.theta
    try:
        found = filled_theta(theta, documented.theta, basis, table)
    except ModelError as error:  # a run's results are not lost over it
        notes.append(f"nothing of it is filled: {error}")
    else:
        said["theta_filled"] = filled_words(basis, documented.tree.body_names)
        if not found.possible:
            off = float(np.sqrt(np.mean((table @ (found.theta - theta).ravel()) ** 2)))
            why = "no possible bodies have what was learned; the nearest are off by"
            notes.append(f"{why} {off:.2g} N m rms")
        theta = found.theta
    return theta, said | ({"theta_note": "; ".join(notes)} if notes else {})


def told_parameters(outcome: Outcome, documented: SelfModel) -> BaseParameters:
    """The combinations of θ that these data told, see `told_basis`; none before θ was learned.

    What the page, the figures and the model file call learned is in them.
    """
    theta = with_bodies(documented).theta
    if outcome.theta_started_ns is None:
        return BaseParameters(0, np.zeros((theta.size, 0)))
    basis = told_basis(outcome.theta_information, theta)
    return BaseParameters(basis.shape[1], basis)


def learned_model(outcome: Outcome, documented: SelfModel, **provenance: Any) -> SelfModel:
    """The self model a run ends with, as it leaves the house: what was learned, and what no data
    showed as the documentation has it, which is said.

    Effects of the documented model that were not learned stay in it as they are; those that
    ended with the recording they were found in are left out. Where the torques were not the arm's
    it is the documentation, which says so.
    """
    if outcome.verdict.refusal is not None:
        said = {"refusal": outcome.verdict.refusal, "theta_source": "documentation"}
        return replace(documented, provenance={**provenance, **said})
    documented, bodies = with_bodies(documented), documented.tree.bodies
    variance = np.einsum("jaa->ja", outcome.lam_covariance)
    shown = np.einsum("jaa->ja", outcome.lam_identifiable) > SHOWN_ALONE
    lam, filled = completed_lambda(outcome, documented)
    known = outcome.theta_started_ns is not None
    told = told_parameters(outcome, documented)
    theta, said = completed_theta(outcome, documented, lam, told.basis)
    share = np.einsum("ab,ab->a", told.basis, told.basis).reshape(-1, 10)
    theta_std, posterior = np.full((bodies, 10), np.nan), None
    if known:  # of what torques told of θ; the rest is documentation
        way = told.shown_map()
        variance_told = np.einsum("ai,ij,aj->a", way, outcome.covariance, way)
        theta_std = np.sqrt(np.maximum(variance_told, 0.0)).reshape(-1, 10)
        if not documented.tree.floating:
            posterior = _posterior(outcome, theta, told)
    return replace(
        documented,
        name=f"{documented.name} (learned)",
        lam=lam,
        theta=theta,
        base_theta=documented.base_theta,
        lam_std=np.where(shown, np.sqrt(np.maximum(variance, 0.0)), np.nan),
        lam_identifiable=shown,
        theta_std=theta_std,
        theta_identifiable=share > SHOWN_ALONE,
        posterior=posterior,
        effects=(*_effects(outcome, documented.tree), *_kept(documented, outcome.settings.effects)),
        lambda_source=LAMBDA_MEASURED if outcome.lam_measured else LAMBDA_REPRODUCED,
        provenance={
            **provenance,
            "lambda_filled": filled,
            **said,
            "changes": changes_at(outcome.changes_ns, outcome.payload, outcome.disagreements),
        },
    )


def _learned(outcome: Outcome) -> Iterator[tuple[LearnedEffect, int, int]]:
    """Effects with their number and joint (from 0), without laws on joints that have them not."""
    for k, effect in enumerate(effects_by_name(outcome.settings.effects)):
        there = outcome.effects_std[k] > NOT_THERE * effect.learned_std
        yield from ((effect, k, int(j)) for j in np.flatnonzero(there))


def _effects(outcome: Outcome, tree: Tree) -> list[dict[str, Any]]:
    """Entries of the model file, one per effect and joint."""
    entries = []
    for effect, k, j in _learned(outcome):
        value, shape = float(outcome.effects[k, j]), float(outcome.shapes[k, j])
        name, parameters = effect.learned_as(value, shape)
        entry = {"effect": name, "joints": [j + 1], "parameters": parameters}
        entry["std"] = {effect.key: float(outcome.effects_std[k, j])}
        entries.append({**entry, "units": KNOWN[name].units(tree.slides[j])})
    return entries


def _posterior(outcome: Outcome, theta: Array, told: BaseParameters) -> Posterior:
    """Doubt of all that was learned: of θ and of frames in the directions that data showed."""
    shown, labels, least = outcome.lam_identifiable, [], []
    places = list(range(theta.size))
    for effect, k, j in _learned(outcome):
        name, _ = effect.learned_as(float(outcome.effects[k, j]), float(outcome.shapes[k, j]))
        labels.append((name, j + 1, effect.key))
        least.append(0.0 if effect.key in effect.positive else -np.inf)
        places.append(theta.size + k * outcome.effects.shape[1] + j)
    way = np.eye(theta.size + outcome.effects.size)[places]
    way[: theta.size, : theta.size] = told.shown_map()
    covariance = way @ outcome.joint_covariance @ way.T
    return Posterior(
        tuple(labels),
        np.array(least),
        root_of(covariance, told.rank + len(labels)),
        room_of(theta, told.basis),
        np.array([root_of(own, len(own)) for own in shown @ outcome.lam_covariance @ shown]),
    )


def _kept(documented: SelfModel, learned: Sequence[str]) -> list[Mapping[str, Any]]:
    """Entries of the documented model that hold on, without the start that they had once."""
    found: list[Mapping[str, Any]] = []
    for entry in documented.effects:
        active = active_effects([entry], documented.tree.n)
        left = [x.entry for x in active if x.lasting and not x.starts(learned)]
        whole = {**entry, "interval_s": None} if "interval_s" in entry else entry
        found += [whole] if len(left) == len(active) else left
    return found


def changes_at(
    stamps_ns: Sequence[int], payload: Load | None, reports: Sequence[Mapping[str, Any]] | None
) -> list[dict[str, Any]]:
    """Changes at the hand, with what the last one brought; since when one is, the watch knows best.

    Args:
        reports: of the watch; None where nothing watched.
    """
    watched = [x["since_s"] for x in reports or () if x["what"] == "payload"]
    found: list[dict[str, Any]] = []
    for at_s in (1e-9 * stamp for stamp in stamps_ns):
        near = min(watched, key=lambda x: abs(x - at_s), default=at_s)
        found.append({"stamp_s": near if abs(near - at_s) <= SAME_LOAD_S else at_s})
    if found and payload is not None:
        found[-1]["payload"] = told_load(payload)
    return found


def told_load(load: Load) -> dict[str, float]:
    """Mass, kg, and centre, m, of a load in the last link's frame."""
    theta, covariance = load
    told = {"m": float(theta[0]), "m_std": float(np.sqrt(covariance[0, 0]))}
    if theta[0] > 0.0:
        _, centre, _ = body_from_theta(theta)
        told.update(zip(("cx", "cy", "cz"), map(float, centre), strict=True))
    return told


def frame_errors(lam: Array, reference: Array, freedom: Freedom) -> tuple[Array, Array]:
    """Rotation (…, n) rad and position (…, n) m errors in what link motion shows.

    The reference is moved to where it is nearest to λ among all frames that move alike.

    Args:
        lam: (..., n, 6); reference: (n, 6); freedom: of its frames.
    """
    R, p = matrix_from_zxz(lam[..., :3]), lam[..., 3:]
    R0, p0 = freedom.nearest(matrix_from_zxz(reference[:, :3]), reference[:, 3:], R, p)
    turn = log_rotation(R @ np.swapaxes(R0, -1, -2))
    return np.linalg.norm(turn, axis=-1), np.linalg.norm(p - p0, axis=-1)
