"""Section IV.A of the paper: the body schema and the dynamics of a humanoid in free fall."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from adapter.experiments.baselines.compare import Errors, arm_tables, compare, contenders
from adapter.experiments.baselines.learner import Columns, sub_chain, sub_parents
from adapter.experiments.baselines.paper import MEMBERS
from adapter.experiments.falls import SETS, Falls, Split, gathered, sets_of, split
from adapter.experiments.networks import NetworkResult, NetworkSettings, schema_by_networks
from adapter.experiments.results import (
    BOX_PERCENTILES,
    PAPER_BASELINES,
    AtlasResults,
    LearnerScores,
    Stated,
)
from adapter.experiments.topology import fall_logs, found_trees, topology_trials
from adapter.learning.batch.prediction_errors import (
    LEAST_TORQUE,
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
from adapter.physics.identifiability import frame_observability
from adapter.runs.outcome import frame_errors
from adapter.runs.replay import BETWEEN_NS
from adapter.runs.terminal import console
from sim.falls.data_set import Flight, data_set
from sim.falls.fall import atlas

ARM = tuple(range(23, 30))  # the right arm: joints 24 to 30 of the paper's Fig. 5e


class Body(NamedTuple):
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


def learn_bodies(data: TreeData, seed: int) -> tuple[NetworkResult, Body, Body]:
    """λ by networks and by moments, and with each θ over bodies that can exist.

    Returns:
        What the networks learned, the body with their λ, that with the moments'.
    """
    clock, begin_s = time.perf_counter, time.perf_counter()
    networks, networks_s = schema_by_networks(data, seed), clock()
    lam, moments_s = schema_from_moments(data).lam, clock()
    first, first_s = learn_theta(data, networks.lam), clock()
    second, second_s = learn_theta(data, lam), clock()
    ours = Body("FOPnet", networks.lam, first, networks_s - begin_s, first_s - moments_s)
    took_s = moments_s - networks_s, second_s - first_s
    return networks, ours, Body("FOPnet, moments", lam, second, *took_s)


class Judged(NamedTuple):
    """What a learned body is worth on all samples.

    Attributes:
        body: which it is.
        learned: torque errors of all joints, as a learner of the comparison.
        arm: the same of the joints alone that the others learn.
        kinematics: the largest on the control set, by channel.
        training: kinematic errors on the samples learned from.
    """

    body: Body
    learned: LearnerScores
    arm: LearnerScores
    kinematics: dict[str, float]
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
        title, took_s = (
            f"First-order-principles networks, λ from {how}",
            body.schema_s + body.theta_s,
        )
        learned = LearnerScores(body.name, title, train_s=took_s)
        learned.tuning = [
            f"λ from {len(learned_from)} samples, 1 % of the training set, by {how} in "
            f"{body.schema_s:.2f} s",
            f"θ over bodies that can exist, {len(body.theta.stages)} sub-problems in "
            f"{body.theta_s:.1f} s",
        ]
        of_arm = part.into(LearnerScores(f"{body.name}, arm", title, train_s=took_s))
        largest = {k: max(x.largest[k] for x in kinematics) for k in kinematics[0].largest}
        training = kinematic_errors(learned_from, body.lam)
        judged.append(Judged(body, whole.into(learned), of_arm, largest, training))
    return judged


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
        "schema_networks_not_converged": [
            tree.joint_names[j] for j in np.flatnonzero(~networks.converged)
        ],
        **_learning(by_networks, by_moments, learners),
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
    by_networks: Judged, by_moments: Judged, learners: list[LearnerScores]
) -> dict[str, Any]:
    """Without a suffix: λ from the moments; `_networks`: from mini-batches, as the paper.

    Best and worst are of the paper's three on the control set, held against ours on the arm alone.
    """
    ours, theta = by_moments.learned, by_moments.body.theta
    settings = NetworkSettings()
    paper = [x for x in learners if x.name in PAPER_BASELINES]
    best = min(paper, key=lambda x: x.median["control"], default=None)
    worst = max(paper, key=lambda x: x.median["control"], default=None)
    error = max(by_networks.arm.median["control"], 1e-300)
    return {
        "minibatch": settings.minibatch,
        "cycles": settings.cycles,
        "theta_solver": "interior point (Clarabel)",
        "kinematic_error_max": by_moments.kinematics,
        "kinematic_error_max_networks": by_networks.kinematics,
        "kinematic_error_max_training": by_moments.training.largest,
        "torque_relative_error_median": ours.median,
        "torque_relative_error_p99": ours.p99,
        "torque_rmse_nm": ours.rmse,
        "torque_relative_error_median_networks": by_networks.learned.median,
        "torque_relative_error_p99_networks": by_networks.learned.p99,
        "min_pseudo_inertia_eigenvalue": theta.min_eigenvalue,
        "base_parameters": theta.rank,
        "theta_converged": theta.converged,
        "sub_problems": [
            {"name": stage.name, "bodies": len(stage.bodies), "rank": stage.rank,
             "parameters": stage.parameters, "wall_s": stage.wall_s}
            for stage in theta.stages
        ],
        "learning_s": by_networks.learned.train_s,
        "learning_moments_s": ours.train_s,
        "schema_networks_s": by_networks.body.schema_s,
        "schema_moments_s": by_moments.body.schema_s,
        "theta_s": by_networks.body.theta_s,
        "learners": {
            x.name: {
                "median": x.median, "p99": x.p99, "rmse_nm": x.rmse, "boxes": x.boxes,
                "train_s": x.train_s, "sizes": x.sizes, "tuning": x.tuning,
                "selection": x.selection,
            }
            for x in (*learners, by_networks.arm, by_moments.arm)
        },
        "box_percentiles": BOX_PERCENTILES,
        "best_baseline": None if best is None else best.name,
        "worst_baseline": None if worst is None else worst.name,
        "control_error_ratio_to_best_baseline": (
            None if best is None else best.median["control"] / error
        ),
    }  # fmt: skip


# --- what the text of section IV.A states, beside what was measured here -------------------------


def _baselines(numbers: dict[str, Any]) -> list[Stated]:
    """The sizes of the paper's three."""

    def size(learner: str, what: str) -> int | None:
        sizes = numbers["learners"].get(learner, {}).get("sizes", {})
        return round(sizes[what]) if what in sizes else None

    arm = numbers["arm_joints"]
    members, points = size("ELM", "members"), size("ELM", "points")
    return [
        Stated("arm", "joints of the right arm", "24 to 30", f"{arm[0]} to {arm[-1]}"),
        Stated("ffnn_units", "network: tanh units", "1000", size("FFNN", "units")),
        Stated("elm_members", "committee: machines", "50", members, "", f"{MEMBERS} with --full"),
        Stated("elm_units", "committee: tanh units of each", "4000", size("ELM", "units")),
        Stated("elm_points", "committee: samples of each", "10 000", points),
        Stated("elm_samples", "committee: samples in all", "50 000",
               None if members is None or points is None else members * points, "",
               "the paper's 50 times 10 000 would be 500 000"),
        Stated("gpr_points", "Gaussian process: samples", "10 000", size("GPR", "points")),
    ]  # fmt: skip


def atlas_stated(numbers: dict[str, Any]) -> list[Stated]:
    """What the paper's text states, beside ours."""
    kinematics = max(numbers["kinematic_error_max"].values())
    networks = max(numbers["kinematic_error_max_networks"].values())
    branches = dict.fromkeys(x["name"] for x in numbers["sub_problems"])
    whole = sum(x["name"] == "whole tree" for x in numbers["sub_problems"])
    ratio = numbers["control_error_ratio_to_best_baseline"]
    seconds = numbers["trajectory_s"]
    return [
        Stated("joints", "degrees of freedom", "30", numbers["joints"]),
        Stated("trajectories", "random trajectories", "63", numbers["trajectories"]),
        Stated("trajectory_s", "length of each, at 1 kHz", "10 s", seconds, "s"),
        Stated("control_trajectories", "of them control", "13", numbers["control_trajectories"]),
        Stated("samples", "samples for training and test", "500 000",
               numbers["train_samples"] + numbers["test_samples"]),
        Stated("train_samples", "of them for training", "75 %", numbers["train_samples"], "",
               "the paper prints 75 %/25 % as test/train"),
        Stated("learned_samples", "samples for λ and θ", "1 % of training",
               numbers["learned_samples"]),
        Stated("minibatch", "samples of a mini-batch; cycles", "10; 10",
               f"{numbers['minibatch']}; {numbers['cycles']}", "",
               "N problems (eq. 18) from random λ, each batch a step of recursive Gauss-Newton"),
        Stated("solver", "solver of θ", "interior point (fmincon)", numbers["theta_solver"]),
        Stated("kinematic_error_max", "largest |k - k_hat|, control set", "negligible", kinematics,
               "", "in m/s, rad/s, m/s² and rad/s², λ from moments"),
        Stated("kinematic_error_max_networks", "the same, λ from mini-batches", "negligible",
               networks),
        Stated("sub_problems", "problems for θ", "3: legs, upper body", ", ".join(branches), "",
               f"found from A; all bodies together {whole} times in the end, later ones weighted "
               "by what the one before left"),
        *(
            Stated(f"torque_median_{name}", f"median error by eq. 20, {name} set", "minimal",
                   numbers["torque_relative_error_median_networks"][name], "",
                   f"where |τ| > {LEAST_TORQUE:g} N m; λ from mini-batches")
            for name in SETS
        ),
        Stated("torque_median_moments", "the same, control set, λ from moments", "minimal",
               numbers["torque_relative_error_median"]["control"]),
        *_baselines(numbers),
        Stated("worst_baseline", "worst of the three, control set", "GPR",
               numbers["worst_baseline"]),
        Stated("control_error_ratio", "right arm, control set: best baseline's error over ours",
               "not stated", ratio, "times"),
        Stated("learning_s", "time to learn λ and θ", "not stated", numbers["learning_s"], "s",
               "without simulating the data; λ from mini-batches"),
        Stated("noise_ratio", "torque error with noise over least squares with true λ",
               "not stated", numbers["noise"]["ratio"], "", "control set"),
        Stated("online_samples_per_second", "samples that the online learner takes",
               "1 kHz (Panda)", numbers["online"]["samples_per_second"], "1/s", "on one core"),
        found_trees(numbers["discover"]),
    ]  # fmt: skip


# --- the 1 kHz learner on the whole robot --------------------------------------------------------

# A look at 30 frames takes half a millisecond, a sample redone 0.1 ms: less of both than on an arm.
SETTINGS = LearnerSettings(rebuild_rows=3, rebuild_stds=3.0, schema=SchemaSettings(judge_every=20))


def noisy(data: TreeData, seed: int) -> TreeData:
    """White noise on all that is measured, no linear velocity, which no sensor on a link shows; the
    wrench of a free fall stays zero."""
    rng = np.random.default_rng(seed)

    def with_noise(*pairs: tuple[Array, float | Array]) -> list[Array]:
        return [x + std * rng.normal(size=x.shape) for x, std in pairs]

    # standard deviations behind a filter: of joints rad, rad/s, rad/s²; of bodies rad/s, m/s²,
    # rad/s²; of torques a share of their own spread
    assert data.links is not None
    (tau,) = with_noise((data.tau, 0.01 * data.tau.std(axis=0)))
    q, dq, ddq = with_noise((data.q, 2e-5), (data.dq, 1e-3), (data.ddq, 2e-2))
    base, links = (
        BodyMotion(*with_noise((x.w, 2e-3), (x.a, 2e-2), (x.dw, 2e-2)))
        for x in (data.base, data.links)
    )
    return TreeData(data.tree, q, dq, ddq, tau, base, links)


def rms(x: Array) -> Array:
    """Root of the mean square of each column."""
    return np.asarray(np.sqrt((x**2).mean(axis=0)))


def held_out(learner: OnlineLearner, test: TreeData) -> dict[str, float]:
    """θ's torque error on exact motion never learned from, and least squares' on the samples."""
    first, states, theta = learner.tree.rows - learner.tree.n, test.states(), learner.theta
    ours = (learner.predict(states) - test.tau)[:, first:]
    in_use, best = theta.th.copy(), theta.least_squares()
    theta.th[:] = best
    batch = (learner.predict(states) - test.tau)[:, first:]
    theta.th[:] = in_use
    ratio = rms(ours) / rms(batch)
    whole, least = (float(np.sqrt((x**2).mean())) for x in (ours, batch))
    return {
        "torque_rms": whole,
        "least_squares_rms": least,
        "over_least_squares": whole / least,
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
    times_ns, history, clock_ns = list[int](), list[dict[str, float]](), 0
    for data in motions:
        for state in data.states(first_ns=clock_ns):
            before = time.perf_counter_ns()
            learner.step(state)
            times_ns.append(time.perf_counter_ns() - before)
            if learner.learned % 5000 == 0 and learner.theta_started_ns is not None:
                off = frame_errors(learner.schema.lam[None], true_lam, seen.freedom)
                turn, shift = (float(x.max()) for x in off)
                where = {"seconds": 1e-3 * learner.learned, "turn_rad": turn, "shift_m": shift}
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
