"""Section IV.A of the paper: the body schema and the dynamics of a humanoid in free fall."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.experiments.baselines.compare import Errors, arm_tables, compare, contenders
from adapter.experiments.baselines.learner import Columns, sub_chain, sub_parents
from adapter.experiments.falls import Falls, Split, gathered, sets_of, split
from adapter.experiments.networks import NetworkResult, NetworkSettings, schema_by_networks
from adapter.experiments.results import BOX_PERCENTILES, AtlasResults, LearnerScores
from adapter.experiments.stated import PAPER_BASELINES, atlas_stated
from adapter.experiments.topology import fall_logs, topology_trials
from adapter.learning.batch.prediction_errors import (
    KinematicErrors,
    kinematic_errors,
    predicted_torques,
)
from adapter.learning.batch.schema import schema_from_moments
from adapter.learning.batch.theta import ThetaResult, learn_theta
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings, SchemaSettings
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.self_model import gravity_down
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.identifiability import frame_observability
from adapter.runs.outcome import frame_errors
from adapter.runs.replay import BETWEEN_NS
from adapter.runs.terminal import console
from sim.falls.data_set import Flight, data_set
from sim.falls.fall import atlas

ARM = tuple(range(23, 30))  # the right arm: joints 24 to 30 of the paper's Fig. 5e


@dataclass(frozen=True)
class Body:
    """λ and θ of a tree as learned from 1 % of the training set.

    Attributes:
        name: "FOPnet", where λ is learned as the paper does; "FOPnet, moments" where it comes
            from the second moments of the same samples.
        lam: (n, 6) λ, with which θ was learned.
        theta: with its sub-problems.
        schema_s, theta_s: seconds for λ, and for θ.
    """

    name: str
    lam: Array
    theta: ThetaResult
    schema_s: float
    theta_s: float

    @property
    def learning_s(self) -> float:
        """Both together."""
        return self.schema_s + self.theta_s


def learn_bodies(data: TreeData, seed: int) -> tuple[NetworkResult, Body, Body]:
    """λ by networks and by moments, and with each θ over bodies that can exist.

    Returns:
        What the networks learned, the body with their λ, that with the moments'.
    """
    marks = [time.perf_counter()]

    def lap() -> float:
        marks.append(time.perf_counter())
        return marks[-1] - marks[-2]

    networks = schema_by_networks(data, seed)
    networks_s = lap()
    lam = schema_from_moments(data).lam
    moments_s = lap()
    bodies = []
    for name, own, schema_s in (
        ("FOPnet", networks.lam, networks_s),
        ("FOPnet, moments", lam, moments_s),
    ):
        theta = learn_theta(data, own)
        bodies.append(Body(name, own, theta, schema_s, lap()))
    return networks, bodies[0], bodies[1]


@dataclass
class Judged:
    """What a learned body is worth on all samples.

    Attributes:
        body: which it is.
        learned: torque errors of all joints, as a learner of the comparison.
        arm: the same of the joints alone that the others learn.
        kinematics: on the control set; training: on the samples learned from.
    """

    body: Body
    learned: LearnerScores
    arm: LearnerScores
    kinematics: KinematicErrors
    training: KinematicErrors


def judge(
    bodies: Sequence[Body], learned_from: TreeData, source: Falls, parts: Split
) -> list[Judged]:
    """Torques on every sample, of all joints and of the arm's; link motion on the control set."""
    n, arm = learned_from.tree.n, list(ARM)
    errors = [(body, Errors(n), Errors(len(arm)), list[KinematicErrors]()) for body in bodies]
    for data, rows in sets_of(source, parts):
        for body, whole, part, kinematics in errors:
            estimate = predicted_torques(data, body.lam, body.theta.theta)[:, -n:]
            for name, own in rows.items():
                tau = data.tau[own][:, -n:]
                whole.add(name, tau, estimate[own])
                part.add(name, tau[:, arm], estimate[own][:, arm])
            if "control" in rows:
                kinematics.append(kinematic_errors(data, body.lam))
    judged = []
    for body, whole, part, kinematics in errors:
        how = "mini-batches" if body.name == "FOPnet" else "second moments"
        title = f"First-order-principles networks, λ from {how}"
        learned = LearnerScores(body.name, title, train_s=body.learning_s)
        learned.tuning = [
            f"λ from {len(learned_from)} samples, 1 % of the training set, by {how} in "
            f"{body.schema_s:.2f} s",
            f"θ over bodies that can exist, {len(body.theta.stages)} sub-problems in "
            f"{body.theta_s:.1f} s",
        ]
        of_arm = part.into(LearnerScores(f"{body.name}, arm", title, train_s=body.learning_s))
        training = kinematic_errors(learned_from, body.lam)
        judged.append(Judged(body, whole.into(learned), of_arm, _worst(kinematics), training))
    return judged


def _worst(parts: list[KinematicErrors]) -> KinematicErrors:
    """Errors of several sets of samples as one."""
    first = parts[0]
    return KinematicErrors(
        {k: max(p.largest[k] for p in parts) for k in first.largest},
        {k: np.sum([p.histogram[k] for p in parts], axis=0) for k in first.histogram},
        first.edges,
        {k: np.max([p.largest_by_link[k] for p in parts], axis=0) for k in first.largest},
    )


def noisy_trial(source: Falls, parts: Split, true_lam: Array) -> dict[str, Any]:
    """Learned λ and θ against weighted least squares with true λ, all from noisy sensors.

    Both see the same filtered samples (1 % of the training set) and are judged on the control
    set, joints in units of what the least squares leaves there.
    """
    data = gathered(source, parts, parts.learned, noisy=True)
    n = data.tree.n
    lam = schema_from_moments(data).lam
    theta = learn_theta(data, lam)
    best = learn_theta(data, true_lam, possible=False)
    square, count = np.zeros((2, n)), 0
    for k in parts.control:
        control = source.measured(k)
        for row, (frames, bodies) in enumerate(((lam, theta.theta), (true_lam, best.theta))):
            estimate = predicted_torques(control, frames, bodies)
            square[row] += np.square((control.tau - estimate)[:, -n:]).sum(axis=0)
        count += len(control)
    ours, least = np.sqrt(square / count)
    return {
        "samples": len(data),
        "control_torque_rmse_nm": ours,
        "least_squares_control_torque_rmse_nm": least,
        "ratio_by_joint": ours / least,
        "ratio": float(np.sqrt(np.mean(np.square(ours / least)))),
        "ratio_of_total": float(np.sqrt(np.sum(ours**2) / np.sum(least**2))),
        "min_pseudo_inertia_eigenvalue": theta.min_eigenvalue,
        "theta_converged": theta.converged,
    }


def run_atlas(args: argparse.Namespace) -> AtlasResults:
    """The whole experiment; says what it is at."""

    def say(line: str) -> None:
        console.print(line, style="dim", soft_wrap=True)

    began = time.perf_counter()
    say(f"simulating {args.trajectories} falls of {args.seconds:g} s, where none are kept")
    flight = Flight(args.seconds, seed=args.seed)
    options = {"trajectories": args.trajectories, "flight": flight, "folder": args.cache}
    robot = atlas()
    source = Falls(data_set(robot, **options), data_set(robot, noise=True, **options))
    truth, tree = source.truth, source.tree
    count = len(source)  # trajectories, all of one length
    parts = split(count * [len(source.exact(0))], args.seed)
    data = gathered(source, parts, parts.learned, noisy=False)
    simulated_s = time.perf_counter() - began
    say(f"learning λ and θ from {len(data)} samples")
    networks, *bodies = learn_bodies(data, args.seed)
    say("judging all samples")
    by_networks, by_moments = judge(bodies, data, source, parts)
    say("learning from noisy sensors")
    noisy_parts = split(count * [len(source.measured(0))], args.seed)
    noise = noisy_trial(source, noisy_parts, truth.lam)
    learners = [by_networks.learned, by_moments.learned]
    if not args.no_baselines:
        # on the right arm alone
        joints = [tree.joint_names[j] for j in ARM]
        carrier = tree.link_names[tree.parent[ARM[0]]]
        index = sub_chain(tree, joints, carrier)
        arm = Columns(len(index)), sub_parents(tree, index), source.truth.lam[index]
        sets = arm_tables(source, parts, joints, carrier)
        learners += compare(sets, contenders(*arm, args.full, args.seed), args.seed, say)
    say("learning online, sample by sample")
    used = [k for k in range(count) if k not in parts.control][:3]  # 30 s in all
    motions = [noisy(source.exact(k), k) for k in used]
    online, _ = online_trial(motions, source.exact(parts.control[0]), truth.lam)
    say(f"finding the tree of {min(args.seeds, count)} falls, shuffled and renamed")
    found = topology_trials(fall_logs(source.noisy, args.seeds), tree, args.seed)
    numbers = {
        "joints": tree.n,
        "arm_joints": [j + 1 for j in ARM],
        "trajectories": count,
        "control_trajectories": len(parts.control),
        "train_samples": len(parts.train),
        "test_samples": len(parts.test),
        "learned_samples": len(data),
        **_learning(networks, by_networks, by_moments, tree),
        **_comparison(learners, [by_networks.arm, by_moments.arm]),
        "noise": noise,
        "online": online,
        "discover": found,
        "trajectory_s": args.seconds,
        "simulated_s": simulated_s,
        "wall_s": time.perf_counter() - began,
    }
    last = max(networks.snapshots)
    return AtlasResults(
        tree=tree,
        true_lam=truth.lam,
        arm=ARM,
        snapshots=[
            ("final" if epoch == last else f"epoch {epoch}", lam)
            for epoch, lam in sorted(networks.snapshots.items())
        ],
        cost=networks.loss,
        error_edges=np.log10(by_moments.training.edges),
        error_counts=by_networks.training.histogram,
        moments_error_counts=by_moments.training.histogram,
        not_converged=tuple(numbers["schema_networks_not_converged"]),
        full=args.full,
        learners=learners,
        stated=atlas_stated(numbers),
        numbers=numbers,
    )


# --- every number of the experiment under a key of its own --------------------------------------


def _learning(
    networks: NetworkResult, by_networks: Judged, by_moments: Judged, tree: Tree
) -> dict[str, Any]:
    """Without a suffix: λ from the moments; `_networks`: from mini-batches, as the paper."""
    ours, theta = by_moments.learned, by_moments.body.theta
    settings = NetworkSettings()
    return {
        "minibatch": settings.minibatch,
        "cycles": settings.cycles,
        "theta_solver": "interior point (Clarabel)",
        "kinematic_error_max": by_moments.kinematics.largest,
        "kinematic_error_max_networks": by_networks.kinematics.largest,
        "kinematic_error_max_training": by_moments.training.largest,
        "torque_relative_error_median": ours.median,
        "torque_relative_error_p99": ours.p99,
        "torque_rmse_nm": ours.rmse,
        "torque_relative_error_median_networks": by_networks.learned.median,
        "torque_relative_error_p99_networks": by_networks.learned.p99,
        "min_pseudo_inertia_eigenvalue": theta.min_eigenvalue,
        "base_parameters": theta.rank,
        "theta_converged": theta.converged,
        "schema_networks_not_converged": [
            tree.joint_names[j] for j in np.flatnonzero(~networks.converged)
        ],
        "sub_problems": [
            {"name": stage.name, "bodies": len(stage.bodies), "rank": stage.rank,
             "parameters": stage.parameters, "wall_s": stage.wall_s}
            for stage in theta.stages
        ],
        "learning_s": by_networks.body.learning_s,
        "learning_moments_s": by_moments.body.learning_s,
        "schema_networks_s": by_networks.body.schema_s,
        "schema_moments_s": by_moments.body.schema_s,
        "theta_s": by_networks.body.theta_s,
    }  # fmt: skip


def _comparison(learners: Sequence[LearnerScores], arms: Sequence[LearnerScores]) -> dict[str, Any]:
    """All learners, and the best and worst of the paper's three on the control set.

    Args:
        learners: of the page.
        arms: the FOP networks on the arm's joints alone, those with the paper's λ first.
    """
    paper = [x for x in learners if x.name in PAPER_BASELINES]
    best = min(paper, key=lambda x: x.median["control"], default=None)
    worst = max(paper, key=lambda x: x.median["control"], default=None)
    ours = max(arms[0].median["control"], 1e-300)
    return {
        "learners": {
            x.name: {
                "median": x.median, "p99": x.p99, "rmse_nm": x.rmse, "boxes": x.boxes,
                "train_s": x.train_s, "sizes": x.sizes, "tuning": x.tuning,
                "selection": x.selection,
            }
            for x in (*learners, *arms)
        },
        "box_percentiles": BOX_PERCENTILES,
        "best_baseline": None if best is None else best.name,
        "worst_baseline": None if worst is None else worst.name,
        "control_error_ratio_to_best_baseline": (
            None if best is None else best.median["control"] / ours
        ),
    }  # fmt: skip


# --- the 1 kHz learner on the whole robot --------------------------------------------------------

LOOK_EVERY = 5000  # samples between two looks at the errors
# Noise of signals behind a filter, standard deviations: rad, rad/s, rad/s² of joints; rad/s,
# m/s², rad/s² of bodies; share of the torque's own spread.
NOISE_Q, NOISE_DQ, NOISE_DDQ = 2e-5, 1e-3, 2e-2
NOISE_W, NOISE_A, NOISE_DW = 2e-3, 2e-2, 2e-2
NOISE_TAU = 0.01
# A look at 30 frames takes half a millisecond, a sample redone 0.1 ms: less of both than on an arm.
SETTINGS = LearnerSettings(rebuild_rows=3, rebuild_stds=3.0, schema=SchemaSettings(judge_every=20))


def noisy(data: TreeData, seed: int) -> TreeData:
    """White noise on all that is measured, no linear velocity, which no sensor on a link shows; the
    wrench of a free fall stays zero."""
    rng = np.random.default_rng(seed)

    def with_noise(x: Array, std: float | Array) -> Array:
        return x + std * rng.normal(size=x.shape)

    def moving(motion: BodyMotion) -> BodyMotion:
        pairs = (motion.w, NOISE_W), (motion.a, NOISE_A), (motion.dw, NOISE_DW)
        return BodyMotion(*(with_noise(*pair) for pair in pairs))

    tau = with_noise(data.tau, NOISE_TAU * data.tau.std(axis=0))
    pairs = (data.q, NOISE_Q), (data.dq, NOISE_DQ), (data.ddq, NOISE_DDQ)
    q, dq, ddq = (with_noise(*pair) for pair in pairs)
    assert data.links is not None
    return TreeData(data.tree, q, dq, ddq, tau, moving(data.base), moving(data.links))


def rms(x: Array) -> Array:
    """Root of the mean square of each column."""
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


def held_out(learner: OnlineLearner, test: TreeData) -> dict[str, float]:
    """θ's torque error on exact motion never learned from, and least squares' on the samples."""
    first = learner.tree.rows - learner.tree.n
    states, theta = test.states(), learner.theta
    ours = (learner.predict(states) - test.tau)[:, first:]
    in_use, best = theta.th.copy(), theta.least_squares()
    theta.th[:] = best
    batch = (learner.predict(states) - test.tau)[:, first:]
    theta.th[:] = in_use
    ratio = rms(ours) / rms(batch)
    return {
        "torque_rms": float(np.sqrt((ours**2).mean())),
        "least_squares_rms": float(np.sqrt((batch**2).mean())),
        "over_least_squares": float(np.sqrt((ours**2).mean() / (batch**2).mean())),
        "worst_joint_over_least_squares": float(ratio.max()),
        "median_joint_relative": float(np.median(rms(ours) / rms(test.tau[:, first:]))),
    }


def online_trial(
    motions: Sequence[TreeData], test: TreeData, true_lam: Array
) -> tuple[dict[str, Any], OnlineLearner]:
    """Learn from motions sample by sample, one after the other.

    Args:
        motions: 1 kHz, as measured.
        test: exact motion never learned from.
        true_lam: (n, 6).

    Returns:
        The figures (times in µs and s), and the learner.
    """
    test = test.take(slice(None, None, 10))
    learner = OnlineLearner(test.tree, settings=SETTINGS)
    seen = frame_observability(learner.tree, true_lam, gravity_down())
    times_ns: list[int] = []
    history: list[dict[str, float]] = []
    clock_ns = 0
    for data in motions:
        for state in data.states(first_ns=clock_ns):
            before = time.perf_counter_ns()
            learner.step(state)
            times_ns.append(time.perf_counter_ns() - before)
            if learner.learned % LOOK_EVERY == 0 and learner.theta_started_ns is not None:
                turn, shift = frame_errors(learner.schema.lam[None], true_lam, seen.freedom)
                where = {
                    "seconds": 1e-3 * learner.learned,
                    "turn_rad": float(turn.max()),
                    "shift_m": float(shift.max()),
                }
                history.append(where | held_out(learner, test))
        clock_ns += round(1e6 * len(data)) + BETWEEN_NS
    started = learner.theta_started_ns
    late = 1e-3 * np.array(times_ns[len(times_ns) // 2 :])
    figures = {
        "joints": learner.tree.n,
        "lambda_rank": learner.schema.rank,
        "lambda_observable": seen.rank,
        "lambda_settled_s": None if started is None else 1e-9 * started,
        "step_p50_us": float(np.percentile(late, 50)),
        "step_p99_us": float(np.percentile(late, 99)),
        "samples_per_second": float(1e6 / late.mean()),
        "rebuilds": learner.rebuilds,
        "history": history,
    }
    return figures, learner
