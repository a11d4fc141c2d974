"""The online learner on whole robots: what a sample costs, and what λ and θ are worth.

    python tests/benchmarks/tree_rate.py [--robot atlas panda] [--json FILE]

ATLAS (30 joints) and the Panda on a floating base (7) fall freely in simulation, several ten-second
motions one after the other. Link motion is what gyroscopes and accelerometers show, no velocity;
noise is that of signals behind a filter (see `noisy`). Prints the median and 99th percentile of
each part of a sample's work on one core, when λ had settled and θ began, and θ's torque error on
a motion never learned from, over that of batch least squares on the same samples.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapter.identifiability import frame_observability
from adapter.outcome import frame_errors
from adapter.robots import documented
from adapter.spatial import matrix_from_zxz
from adapter.tree import Tree
from adapter.tree_data import BodyMotion, TreeData
from adapter.tree_learner import TreeLearner, samples_of
from sim.free_fall_data import data_set
from sim.tree_links import link_tables
from sim.tree_truth import TreeLimits, TreeTruth

Row = dict[str, Any]
HELD_OUT_EVERY = 10  # samples
PAUSE_NS = 1_000_000_000  # between two motions
# Standard deviations: rad, rad/s, rad/s² of joints; rad/s, m/s², rad/s² of bodies; share of the
# torque's own spread.
NOISE_Q, NOISE_DQ, NOISE_DDQ = 2e-5, 1e-3, 2e-2
NOISE_W, NOISE_A, NOISE_DW = 2e-3, 2e-2, 2e-2
NOISE_TAU = 0.01


def motions(robot: str, folder: Path, count: int) -> tuple[Any, list[TreeData]]:
    """The truth, and `count` exact motions of it with no velocity measured."""
    source = floating_panda() if robot == "panda" else robot
    data = data_set(source, trajectories=count, folder=folder)
    truth = data.truth
    tree = Tree(
        tuple(truth.parent),
        True,
        tuple(truth.joint_names),
        tuple(truth.link_names),
        truth.base_name,
    )
    parts = []
    for k in range(count):
        rec = data.exact(k)
        fall = (rec.base_v, rec.base_w, rec.base_a, rec.base_dw)
        links = link_tables(truth, rec.q, rec.dq, rec.ddq, fall)
        tau = np.hstack([np.zeros((len(rec.q), 6)), rec.tau])
        base = BodyMotion(rec.base_w, rec.base_a, rec.base_dw)
        parts.append(
            TreeData(
                tree, rec.q, rec.dq, rec.ddq, tau, base, BodyMotion(links.w, links.a, links.dw)
            )
        )
    return truth, parts


def floating_panda() -> TreeTruth:
    """The documented Panda with its base set free."""
    model = documented("panda", floating=True)
    tree, limits = model.tree, model.limits
    return TreeTruth(
        "panda",
        tree.joint_names,
        tree.link_names,
        tree.base_name,
        tree.parent,
        matrix_from_zxz(model.lam[:, :3]),
        model.lam[:, 3:],
        model.theta,
        TreeLimits(limits.lower, limits.upper, limits.velocity, limits.effort),
        model.gravity,
    )


def noisy(data: TreeData, seed: int) -> TreeData:
    """White noise on all that is measured; the wrench of a free fall stays zero."""
    rng = np.random.default_rng(seed)

    def with_noise(x: np.ndarray, std: float | np.ndarray) -> np.ndarray:
        return x + std * rng.normal(size=x.shape)

    def moving(motion: BodyMotion) -> BodyMotion:
        return BodyMotion(
            with_noise(motion.w, NOISE_W),
            with_noise(motion.a, NOISE_A),
            with_noise(motion.dw, NOISE_DW),
        )

    tau = with_noise(data.tau, NOISE_TAU * data.tau.std(axis=0))
    joints = (
        with_noise(x, std)
        for x, std in ((data.q, NOISE_Q), (data.dq, NOISE_DQ), (data.ddq, NOISE_DDQ))
    )
    assert data.links is not None
    return TreeData(data.tree, *joints, tau, moving(data.base), moving(data.links))


def rms(x: np.ndarray) -> np.ndarray:
    """Root of the mean square of each column."""
    return np.sqrt((x**2).mean(axis=0))


def held_out(learner: TreeLearner, test: TreeData) -> Row:
    """θ's torque error on exact motion never learned from, and least squares' on the samples."""
    first = learner.tree.rows - learner.tree.n
    ours = (learner.predict(test) - test.tau)[:, first:]
    theta = learner.theta
    in_use, best = theta.th.copy(), theta.least_squares()
    theta.th[:] = best
    batch = (learner.predict(test) - test.tau)[:, first:]
    theta.th[:] = in_use
    ratio = rms(ours) / rms(batch)
    return {
        "torque_rms": float(np.sqrt((ours**2).mean())),
        "least_squares_rms": float(np.sqrt((batch**2).mean())),
        "over_least_squares": float(np.sqrt((ours**2).mean() / (batch**2).mean())),
        "worst_joint_over_least_squares": float(ratio.max()),
        "median_joint_relative": float(np.median(rms(ours) / rms(test.tau[:, first:]))),
    }


def learn(robot: str, folder: Path, seconds: float, noise: bool) -> tuple[Row, TreeLearner]:
    """Learn sample by sample; what came of it and how long the samples took."""
    count = round(seconds / 10.0)
    truth, parts = motions(robot, folder, count + 1)
    test = parts[-1].take(slice(None, None, HELD_OUT_EVERY))
    learner = TreeLearner(parts[0].tree)
    seen = frame_observability(learner.tree, truth.lam, np.array([0.0, 0.0, -9.81]))
    times_ns, clock_ns = [], 0
    history: list[Row] = []
    for k, part in enumerate(parts[:-1]):
        data = noisy(part, k) if noise else part
        for sample in samples_of(data, first_ns=clock_ns):
            before = time.perf_counter_ns()
            learner.step(sample)
            times_ns.append(time.perf_counter_ns() - before)
            if learner.learned % 5000 == 0 and learner.theta_started_ns is not None:
                turn, shift = frame_errors(learner.schema.lam[None], truth.lam, seen.projectors)
                history.append(
                    {"seconds": learner.learned / 1e3, "turn_rad": float(turn.max())}
                    | {"shift_m": float(shift.max())}
                    | held_out(learner, test)
                )
        clock_ns = sample.stamp_ns + PAUSE_NS
    started = learner.theta_started_ns
    late = np.array(times_ns[len(times_ns) // 2 :]) / 1e3
    row: Row = {
        "robot": robot,
        "joints": learner.tree.n,
        "noise": noise,
        "lambda_rank": learner.schema.learner.rank,
        "lambda_observable": seen.rank,
        "lambda_settled_s": None if started is None else 1e-9 * started,
        "step_p50_us": float(np.percentile(late, 50)),
        "step_p99_us": float(np.percentile(late, 99)),
        "steps_per_second": float(1e6 / late.mean()),
        "rebuilds": learner.rebuilds,
        "history": history,
    }
    return row, learner


def parts_of(learner: TreeLearner, data: TreeData, repeats: int) -> Row:
    """Median time of each part of a sample's work, µs."""
    schema, theta = learner.schema, learner.theta
    samples = list(samples_of(data.take(slice(0, repeats)), first_ns=10**15))
    spare, frames = theta.empty_moments(), learner.frames
    links = [np.ascontiguousarray(s.links) for s in samples]

    def rows(k: int, times: int) -> list[np.ndarray]:
        s = samples[k]
        return [np.repeat(x[None], times, axis=0) for x in (s.q, s.dq, s.ddq, s.tau, s.base)]

    def look(k: int) -> None:
        schema.learner.updates = 0
        schema.compute_gradient()

    def glance(k: int) -> None:
        schema.learner.updates = 1
        schema.compute_gradient()

    work: dict[str, Callable[[int], object]] = {
        "moments of λ": lambda k: schema.absorb(
            samples[k].stamp_ns,
            samples[k].q,
            samples[k].dq,
            samples[k].ddq,
            samples[k].base,
            links[k],
        ),
        "gradient of λ": glance,
        "gradient of λ with a look at its curvature (every 20th)": look,
        "regressor and prediction": lambda k: theta.absorb(
            *frames, rows(k, 1), into=(theta.A[:0], theta.C)
        ),
        "regressor, prediction, moments of θ": lambda k: theta.absorb(
            *frames, rows(k, 1), into=spare
        ),
        "three samples redone (while a rebuild lasts)": lambda k: theta.absorb(
            *frames, rows(k, 3), into=spare
        ),
        "gradient of θ": lambda k: theta.compute_gradient(),
        "ADAM on λ and θ": lambda k: learner.adam.step(),
    }
    out: Row = {}
    for name, part in work.items():
        times = []
        for k in range(len(samples)):
            before = time.perf_counter_ns()
            part(k)
            times.append(time.perf_counter_ns() - before)
        out[name] = float(np.median(times)) / 1e3
    return out


def print_row(row: Row) -> None:
    """One robot's table."""
    noise = "with noise" if row["noise"] else "without noise"
    print(f"\n{row['robot']}, {row['joints']} joints, floating base, free fall, {noise}")
    print(
        f"  a sample: p50 {row['step_p50_us']:.0f} µs, p99 {row['step_p99_us']:.0f} µs; "
        f"{row['steps_per_second']:.0f} a second on one core"
    )
    for name, value in row["parts_p50_us"].items():
        print(f"    {name}: {value:.0f} µs")
    print(
        f"  λ settled and θ began after {row['lambda_settled_s']} s; directions shown: "
        f"{row['lambda_rank']} of {row['lambda_observable']}; rebuilds: {row['rebuilds']}"
    )
    for h in row["history"]:
        print(
            f"    {h['seconds']:4.0f} s  λ {h['turn_rad']:.1e} rad {h['shift_m']:.1e} m  torque "
            f"rms {h['torque_rms']:.2e} N m, {h['over_least_squares']:.2f} x least squares (worst "
            f"joint {h['worst_joint_over_least_squares']:.2f}), relative "
            f"{h['median_joint_relative']:.1e}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="The online learner on whole robots.")
    parser.add_argument("--robot", nargs="+", default=["atlas", "panda"])
    parser.add_argument("--seconds", type=float, default=30.0, help="of motion to learn from")
    parser.add_argument("--data", type=Path, help="folder of the simulated motions")
    parser.add_argument("--exact", action="store_true", help="without noise")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    with tempfile.TemporaryDirectory() as made:
        folder = args.data or Path(made)
        for robot in args.robot:
            row, learner = learn(robot, folder, args.seconds, not args.exact)
            data = motions(robot, folder, 1)[1][0]
            row["parts_p50_us"] = parts_of(learner, data, 500)
            print_row(row)
            rows.append(row)
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
