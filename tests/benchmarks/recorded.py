"""A recording of a simulated arm's run against its truth: what θ is worth over a real wire.

    adapter sim fci --port 1340 --seed 3 &
    adapter run --driver fci://127.0.0.1:1340 --allow-motion --duration 30 --out runs/wire
    python tests/benchmarks/recorded.py runs/wire/recording.mcap --seed 3

Replays the recording sample by sample and prints the error of θ's torque on noiseless motion that
was never learned from, over that of batch least squares on the same samples, at 15 s and at the
end; times count from the end of a slow start.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from trials import held_out, regressor_rows

from adapter.model.robots import documented
from adapter.runs.config import config_from
from adapter.runs.pipeline import make_front_end, make_learner
from drivers.files.log import LogArm
from sim.scenarios import build

EARLY_S, END_S = 15.0, 1.5  # the second before the end, when the arm comes to rest


def score(path: Path, scenario: str, seed: int, effects: tuple[str, ...] | None) -> dict[str, Any]:
    """The figures of one recording."""
    import torch

    torch.set_num_threads(1)
    arm = LogArm(path)
    config = config_from(arm.log.metadata["config"])
    pipeline = config.pipeline
    if effects is not None:
        learner_settings = dataclasses.replace(pipeline.learner, effects=effects)
        pipeline = dataclasses.replace(pipeline, learner=learner_settings)
    robot = documented("panda")
    front_end, learner = make_front_end(robot, pipeline), make_learner(robot, pipeline)
    q, dq, ddq, tau = held_out(seed, np.array(build(scenario, seed).truth.theta))
    Y: Any = None
    start_s: float | None = None
    rows: dict[str, Any] = {}
    due = [EARLY_S, 1e-9 * int(arm.log.stamp_ns[-1] - arm.log.stamp_ns[0]) - END_S]
    arm.connect()
    for _ in range(len(arm)):
        sample = arm.read()
        state = front_end.step(sample)
        if state is None:
            continue
        if start_s is None:
            start_s = 1e-9 * sample.stamp_ns + config.excitation.slow_s
            due[1] -= config.excitation.slow_s
        learner.step(state)
        t = 1e-9 * sample.stamp_ns - start_s
        if due and t >= due[0] and learner.theta.updates:
            due.pop(0)
            theta = learner.theta
            Y = regressor_rows(theta, q, dq, ddq) if Y is None else Y
            errors = [Y @ x - tau for x in (theta.theta.ravel(), theta.least_squares()[:70])]
            ours, best = (float(np.sqrt(np.mean(e**2))) for e in errors)
            figures = {"error_nm": ours, "least_squares_nm": best, "ratio": ours / best}
            rows[f"at_{t:.0f}_s"] = figures
    return {"samples": len(arm), "refused": dict(front_end.refused), **rows}


def main() -> None:
    """Score and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path)
    parser.add_argument("--scenario", default="nominal")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-effects", action="store_true", help="learn θ alone")
    args = parser.parse_args()
    effects = () if args.no_effects else None
    print(json.dumps(score(args.path, args.scenario, args.seed, effects), indent=1))


if __name__ == "__main__":
    main()
