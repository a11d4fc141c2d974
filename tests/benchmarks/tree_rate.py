"""The online learner on whole robots: what a sample costs, and what λ and θ are worth.

    PYTHONPATH=. python tests/benchmarks/tree_rate.py [--robot atlas panda] [--json FILE]

ATLAS (30 joints) and the Panda on a floating base fall freely, seen by gyroscopes and
accelerometers. Prints p50 and p99 of each part of a sample's work on one core, when λ had settled,
and θ's torque error on a motion never learned from, over that of batch least squares.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapter.experiments.atlas import noisy, online_trial
from adapter.experiments.falls import Falls
from adapter.learning.learner import OnlineLearner
from adapter.learning.tree_data import TreeData
from adapter.model.robots import documented
from adapter.model.spatial import matrix_from_zxz
from sim.falls.data_set import data_set
from sim.falls.fall import TreeTruth, atlas
from sim.truth import Limits
from tests.helpers.benchmark import Row, options, write


def motions(robot: str, folder: Path, count: int) -> tuple[Any, list[TreeData]]:
    """The truth, and `count` exact motions of it with no velocity measured."""
    data = data_set(floating_panda() if robot == "panda" else atlas(), count, folder=folder)
    source = Falls(data, data)
    found = []
    for exact in map(source.exact, range(count)):
        assert exact.links is not None
        links = replace(exact.links, v=None)
        found.append(replace(exact, base=replace(exact.base, v=None), links=links))
    return source.truth, found


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
        Limits(limits.lower, limits.upper, limits.velocity, limits.effort, np.inf * limits.effort),
        model.gravity,
    )


def learn(robot: str, folder: Path, seconds: float) -> tuple[Row, OnlineLearner]:
    """Learn sample by sample; what came of it and how long the samples took."""
    truth, parts = motions(robot, folder, round(seconds / 10.0) + 1)
    learned_from = [noisy(part, k) for k, part in enumerate(parts[:-1])]
    figures, learner = online_trial(learned_from, parts[-1], truth.lam)
    return {"robot": robot, **figures}, learner


def parts_of(learner: OnlineLearner, data: TreeData, repeats: int) -> Row:
    """Median time of each part of a sample's work, µs."""
    schema, theta, frames = learner.schema, learner.theta, learner.frames
    states = data.take(slice(0, repeats)).states(first_ns=10**15)
    spare = theta.empty_moments()

    def gradient(updates: int) -> None:
        schema.updates = updates
        schema.compute_gradient()

    work: dict[str, Callable[[int], object]] = {
        "moments of λ": lambda k: schema.absorb(states[k : k + 1]),
        "gradient of λ": lambda k: gradient(1),
        "gradient of λ with a look at its curvature (every 20th)": lambda k: gradient(0),
        "regressor and prediction": lambda k: theta.errors(frames, states[k : k + 1]),
        "regressor, prediction, moments of θ": lambda k: theta.absorb_again(
            frames, states[k : k + 1], spare
        ),
        "three samples redone (while a rebuild lasts)": lambda k: theta.absorb_again(
            frames, states[k : k + 3], spare
        ),
        "gradient of θ": lambda k: theta.compute_gradient(),
        "ADAM on λ and θ": lambda k: learner.adam.step(),
    }
    out: Row = {}
    for name, part in work.items():
        times = []
        for k in range(len(states) - 3):
            before = time.perf_counter_ns()
            part(k)
            times.append(time.perf_counter_ns() - before)
        out[name] = float(np.median(times)) / 1e3
    return out


def print_row(row: Row) -> None:
    """One robot's table."""
    print(f"\n{row['robot']}, {row['joints']} joints, floating base, free fall, with noise")
    print(
        f"  a sample: p50 {row['step_p50_us']:.0f} µs, p99 {row['step_p99_us']:.0f} µs; "
        f"{row['samples_per_second']:.0f} a second on one core"
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
    parser = options("The online learner on whole robots.")
    parser.add_argument("--robot", nargs="+", default=["atlas", "panda"])
    parser.add_argument("--seconds", type=float, default=30.0, help="of motion to learn from")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for robot in args.robot:
            row, learner = learn(robot, folder, args.seconds)
            data = motions(robot, folder, 1)[1][0]
            row["parts_p50_us"] = parts_of(learner, data, 500)
            print_row(row)
            rows.append(row)
    write(args.json, rows)


if __name__ == "__main__":
    main()
