"""Statistical trials over many seeds on the simulated arm, in lockstep: `make trials`.

Prints one line a trial; the figures in docs/numbers.md come from here. Each trial is what
`adapter run` runs with the same options: model, settings, effects and driver come from the
command's own code.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.cli.main import build_parser
from adapter.cli.run import controller_of, run_plan
from adapter.control.excitation import RandomMotion
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.effects.by_joint import JointSignals
from adapter.effects.torque import ModelTorque
from adapter.learning.learner import OnlineLearner
from adapter.learning.theta import Theta
from adapter.model.inertia import min_eigenvalue
from adapter.model.robots import documented
from adapter.realtime.session import run_lockstep
from adapter.runs.library import regressor
from adapter.runs.outcome import collect
from adapter.runs.pipeline import make_front_end, make_learner
from adapter.runs.score import reference_from, schema_score, theta_score
from adapter.signals.records import stamp_of
from drivers.interface import Driver
from sim.scenarios import Scenario, build
from tests.helpers.benchmark import Row, options, shown, write

LATE_S, END_S = 15.0, 30.0


class Watched:
    """A learner that calls `look` with itself before each state it learns from."""

    def __init__(
        self, learner: OnlineLearner, look: Callable[[OnlineLearner, np.ndarray], None]
    ) -> None:
        self.learner, self._look = learner, look

    def step(self, record: np.ndarray) -> None:
        self._look(self.learner, record)
        self.learner.step(record)


@dataclass(frozen=True)
class Task:
    """What is run, as on the command line of `adapter run`.

    Attributes:
        scenario, seed, duration_s: of the run.
        options: further ones of the command line.
        rests: spans (from, to) in s during which the arm rests.
        arm_of: driver of a scenario and a seed; the command's own where None.
    """

    scenario: str
    seed: int
    duration_s: float
    options: tuple[str, ...] = ()
    rests: tuple[tuple[float, float], ...] = ()
    arm_of: Callable[[Scenario, int], Driver] | None = None


def learn(
    task: Task, look: Callable[[OnlineLearner, np.ndarray], None] = lambda learner, record: None
) -> tuple[Row, OnlineLearner]:
    """Run what `adapter run` runs, without its clock; the figures of λ and θ, and the learner."""
    import torch

    torch.set_num_threads(1)
    run = ["run", "--scenario", task.scenario, "--seed", str(task.seed)]
    run += ["--duration", str(task.duration_s), *task.options]
    args = build_parser().parse_args(run)
    plan = run_plan(args)
    config, robot, world = plan.config, plan.robot, plan.world
    assert world is not None
    if task.rests:
        config = replace(config, excitation=replace(config.excitation, rests=task.rests))
        plan = replace(plan, config=config)
    front_end = make_front_end(robot, config.pipeline)
    learner = make_learner(robot, config.pipeline)
    arm = task.arm_of(world.scenario, task.seed) if task.arm_of else plan.open(args.driver, False)
    controller = controller_of(args, plan, arm)
    watched = Watched(learner, look)
    result = run_lockstep(arm, front_end, watched, controller, args.duration)
    arm.close()
    assert result.fault is None, result.fault
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.json"
        world.scenario.write_truth(truth)
        reference = reference_from(truth, robot)
    outcome = collect(learner)
    start_s = 1e-9 * (front_end.first_moving_ns or 0) - front_end.delay_s
    figures = {
        "seed": task.seed,
        "lambda": schema_score(outcome, robot, reference, start_s),
        "theta": theta_score(outcome, robot, start_s),
    }
    return figures, learner


def schema_trial(job: tuple[str, int, str]) -> Row:
    """λ from synthesized or measured motion."""
    scenario, seed, mode = job
    seconds = 12.0 if mode == "sample" else 8.0
    figures, _ = learn(Task(scenario, seed, seconds, ("--mode", mode)))
    lam = figures["lambda"]
    return {
        "seed": seed,
        "converged_s": lam["converged_s"],
        "rotation_rad": max(lam["rotation_error_rad"]),
        "position_m": max(lam["position_error_m"]),
        "rank": lam["identifiable_rank"],
        "rebuilds": figures["theta"]["rebuilds"],
    }


def held_out(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(q, dq, ddq) of a motion that was never learned from, and the true torque along it."""
    motion = RandomMotion(
        MotionLimits.of(documented("panda")),
        np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4]),
        ExcitationSettings(seed=10_000 + seed),
    )
    rows = []
    for _ in range(1000):
        motion.advance(0.02)
        rows.append((motion.q.copy(), motion.dq.copy(), motion.ddq.copy()))
    q, dq, ddq = (np.array(column) for column in zip(*rows, strict=True))
    truth = replace(documented("panda"), theta=build("nominal", seed).truth.theta)
    return q, dq, ddq, ModelTorque(truth)(q, dq, ddq)


def columns_of(theta: Theta, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """(m, 7, P) what each parameter of the learner, effects included, adds to the torque.

    Columns of the spare body are zero: these trials know no change.
    """
    out, joint = np.zeros((*q.shape, theta.P)), np.arange(7)
    out[..., :70] = regressor(documented("panda"), q, dq, ddq)
    for k, column in enumerate(theta.torque_per_unit(JointSignals(q, dq, ddq))):
        out[:, joint, 80 + 7 * k + joint] = column
    return out


def theta_trial(
    job: tuple[int],
    arm_of: Callable[[Scenario, int], Driver] | None = None,
    options: tuple[str, ...] = (),
) -> Row:
    """θ against batch least squares with the same effects on the same samples.

    Both are judged by torque, effects included, on a noiseless motion that neither has seen.
    """
    (seed,) = job
    q, dq, ddq, tau = held_out(seed)
    Y: list[np.ndarray] = []
    ratios: list[tuple[float, ...]] = []
    lowest = [np.inf]

    def look(learner: OnlineLearner, record: np.ndarray) -> None:
        theta = learner.theta
        if theta.updates % 50 or not theta.updates:
            return
        if not Y:
            Y.append(columns_of(theta, q, dq, ddq))
        lowest[0] = min(lowest[0], float(np.min(min_eigenvalue(theta.theta))))
        t = 1e-9 * stamp_of(record)
        if t < LATE_S - 5.0:
            return
        noise = np.sqrt(theta.variance())
        errors = [Y[0] @ th - tau for th in (theta.th, theta.least_squares())]
        weighted = [float(np.sqrt(np.mean((e / noise) ** 2))) for e in errors]
        plain = [float(np.sqrt(np.mean(e**2))) for e in errors]
        ratios.append((t, weighted[0] / weighted[1], plain[0] / plain[1], *plain))

    figures, learner = learn(Task("nominal", seed, END_S, options, arm_of=arm_of), look)
    table = np.array(ratios)
    late = table[table[:, 0] >= LATE_S]
    lam, theta = figures["lambda"]["converged_s"], figures["theta"]["converged_s"]
    return {
        "seed": seed,
        "worst_from_15_s": late[:, 1].max(),
        "worst_from_15_s_unweighted": late[:, 2].max(),
        "at_30_s": late[-1, 1],
        "at_30_s_unweighted": late[-1, 2],
        "error_at_30_s_nm": late[-1, 3],
        "least_squares_at_30_s_nm": late[-1, 4],
        "lambda_converged_s": lam,
        "theta_converged_s": theta,
        "theta_after_lambda_s": None if theta is None or lam is None else theta - lam,
        "min_eigenvalue": lowest[0],
        "changes": len(figures["theta"]["changes"]),
        **{
            f"largest_{effect.name}": float(np.abs(row).max())
            for effect, row in zip(learner.theta.effects, learner.theta.effect_values, strict=True)
        },
    }


def can_arm(world: Scenario, seed: int) -> Driver:
    """The arm behind Damiao motors: 16, 12 and 12 bits, replies of the joints one by one."""
    from tests.helpers.lockstep_drivers import on_line

    return on_line(world)[0]


def wire_trial(job: tuple[str, int]) -> Row:
    """What the sensors and the wire cost: noiseless, a Panda's noise (FCI), Damiao frames."""
    wire, seed = job
    if wire == "can":
        return {"wire": wire, **theta_trial((seed,), can_arm)}
    noise = "none" if wire == "noiseless" else "real"
    return {"wire": wire, **theta_trial((seed,), options=("--set", f"noise={noise}"))}


def payload_trial(job: tuple[int, float]) -> Row:
    """A load picked up at 20 s: prequential torque error and its mass afterwards."""
    seed, mass = job
    errors: list[tuple[float, np.ndarray]] = []
    marks: Row = {}

    def look(learner: OnlineLearner, record: np.ndarray) -> None:
        t = 1e-9 * stamp_of(record) + 0.0375  # the sample that completed the state
        if t < 18.0:
            return
        theta = learner.theta
        errors.append((t, theta.errors(learner.frames, record[None])[0]))
        if t < 20.0:
            marks["before"] = (learner.schema.R0.copy(), learner.schema.p.copy())
            marks["noise"] = np.sqrt(theta.variance())
        payload = theta.payload
        for after in (1.0, 5.0):
            if payload is not None and t >= 20.0 + after and f"mass_{after:.0f}_s" not in marks:
                marks[f"mass_{after:.0f}_s"] = float(payload[0][0])

    task = Task("payload_at_20s", seed, 26.0, ("--set", f"mass={mass}"))
    figures, learner = learn(task, look)
    t = np.array([row[0] for row in errors])
    e = np.array([row[1] for row in errors])

    def rms(first: float, last: float, scale: np.ndarray | float) -> float:
        inside = (t >= first) & (t < last)
        return float(np.sqrt(np.mean((e[inside] / scale) ** 2)))

    R0, p = marks["before"]
    moved = max(np.abs(learner.schema.R0 - R0).max(), np.abs(learner.schema.p - p).max())
    changes = figures["theta"]["changes"]
    return {
        "seed": seed,
        "mass": mass,
        "alarms": len(changes),
        "seen_after_s": changes[0]["stamp_s"] + 0.0375 - 20.0 if changes else None,
        "ratio_weighted": rms(20.8, 21.0, marks["noise"]) / rms(18.0, 20.0, marks["noise"]),
        "ratio": rms(20.8, 21.0, 1.0) / rms(18.0, 20.0, 1.0),
        "mass_1_s": marks.get("mass_1_s"),
        "mass_5_s": marks.get("mass_5_s"),
        "lambda_moved": float(moved),
    }


def null_trial(job: tuple[str, int]) -> Row:
    """No change: how many alarms."""
    scenario, seed = job
    figures, _ = learn(Task(scenario, seed, END_S))
    return {"scenario": scenario, "seed": seed, "alarms": len(figures["theta"]["changes"])}


def rest_trial(job: tuple[int]) -> Row:
    """Rest for 60 s after 20 s of motion: nothing drifts, and learning goes on where it was."""
    (seed,) = job
    marks: Row = {}
    errors: list[tuple[float, float]] = []

    def look(learner: OnlineLearner, record: np.ndarray) -> None:
        t = 1e-9 * stamp_of(record)
        theta = learner.theta
        if not theta.updates:
            return
        error = theta.errors(learner.frames, record[None])[0]
        errors.append((t, float(np.mean((error / np.sqrt(theta.variance())) ** 2))))
        key = "before" if t < 50.0 else "after"
        if key == "before" or "after" not in marks:
            marks[key] = np.concatenate([theta.mean, learner.schema.lam.ravel()])

    learn(Task("nominal", seed, 84.0, rests=((20.0, 80.0),)), look)
    table = np.array(errors)
    before = table[(table[:, 0] > 15.0) & (table[:, 0] < 19.0), 1].mean()
    after = table[(table[:, 0] > 50.0), 1][:2000].mean()
    drift = float(np.abs(marks["after"] - marks["before"]).max())
    return {"seed": seed, "drift": drift, "error_after_over_before": float(np.sqrt(after / before))}


TRIALS: dict[str, tuple[Callable[[Any], Row], list[Any]]] = {
    "lambda_synthesized": (schema_trial, [("nominal", s, "moments") for s in range(10)]),
    "lambda_measured": (schema_trial, [("bent_link", s, "moments") for s in range(10)]),
    "lambda_sample_mode": (schema_trial, [("nominal", s, "sample") for s in range(3)]),
    "theta": (theta_trial, [(s,) for s in range(10)]),
    "wire": (wire_trial, [(w, s) for w in ("noiseless", "fci", "can") for s in range(5)]),
    "payload": (payload_trial, [(s, m) for m in (0.1, 0.3, 1.0) for s in range(5)]),
    "null": (null_trial, [(n, s) for n in ("nominal", "friction") for s in range(100, 110)]),
    "rest": (rest_trial, [(s,) for s in range(3)]),
}


def main() -> None:
    """Run the trials that were asked for."""
    parser = options(__doc__, workers=2)
    parser.add_argument("trials", nargs="*", metavar="TRIAL", help=f"of {', '.join(TRIALS)}")
    parser.add_argument("--seeds", type=int, help="only so many jobs of each trial")
    args = parser.parse_args()
    chosen = args.trials or list(TRIALS)
    for name in chosen:
        if name not in TRIALS:
            parser.error(f"no trial '{name}'; have: {', '.join(TRIALS)}")
    found: dict[str, list[Row]] = {}
    with ProcessPoolExecutor(args.workers) as pool:
        for name in chosen:
            trial, jobs = TRIALS[name]
            began = time.monotonic()
            found[name] = []
            for row in pool.map(trial, jobs[: args.seeds]):
                found[name].append(row)
                print(name, shown(row), flush=True)
            spent_s = time.monotonic() - began
            print(f"{name}: {len(found[name])} trials in {spent_s:.0f} s", flush=True)
    write(args.json, json.loads(json.dumps(found, default=float)))


if __name__ == "__main__":
    main()
