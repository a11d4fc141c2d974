"""One simulated log at many rates: what is learned from it, beside batch least squares.

Each trial moves a PyBullet Panda with a real arm's friction and noise, rests in between, and keeps
every k-th sample; at the end stands how far friction and inertia are from those that the fastest
rate finds. With `--unchanged` the arm stops and starts often, every other log is of a motion
three times slower, where friction sticks for longer, and what is said to have changed, all of it
false, is all that is asked. `make trials`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adapter.control.controller import ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.torque import ModelTorque
from adapter.learning.settings import LearnerSettings
from adapter.learning.theta import Theta
from adapter.model.self_model import SelfModel
from adapter.physics.freedom import Freedom
from adapter.realtime.session import run_lockstep
from adapter.runs.config import PipelineSettings
from adapter.runs.library import regressor
from adapter.runs.outcome import completed_lambda, frame_errors, learned_model
from adapter.runs.pipeline import Pipeline, make_front_end
from adapter.runs.replay import ReplayOptions, fitted_to, replay, seconds
from adapter.signals.validation import EDGE_S, GRID_S, rms_of, smooth, validation_error
from drivers.files.mcap import Log
from drivers.interface import Array, JointSample
from sim.plant import SimulatedArm
from sim.scenarios import build
from tests.helpers.arm_data import panda_model
from tests.helpers.benchmark import options, told, with_columns

RATES = (1000, 500, 250, 125, 60, 30)
REST_S = 1.5  # of each rest
SPEED = 0.5  # rad/s, at which friction is compared between rates
ROW_EVERY = 5  # ms between two rows of the least squares


SLOWER_UNCHANGED = 3.0  # every other log of `--unchanged`, where friction sticks for longer


class Recipe(NamedTuple):
    """How an arm is recorded.

    Attributes:
        seconds: the log's length.
        slower: than the usual motion, this many times.
        links: whether links are measured.
        rest_every: seconds from a rest's begin to the next one's; the first after as many.
    """

    seconds: float
    slower: float = 1.0
    links: bool = False
    rest_every: float = 9.0


def recorded(seed: int, recipe: Recipe) -> tuple[Log, SelfModel]:
    """A motion with rests of an arm with friction that sticks, and what the model should become."""
    seconds_long, slower, links, rest_every = recipe
    arm, robot = build("real_drives", seed, links=links), panda_model()
    rests = tuple((at, at + REST_S) for at in np.arange(rest_every, seconds_long, rest_every))
    low, high = 0.1 / slower, 1.0 / slower
    motion = ExcitationSettings(seed=seed, low_hz=low, high_hz=high, rests=rests, share=0.7)
    forward = ModelFeedforward.of(robot)
    controller = ExcitationController(MotionLimits.of(robot), motion, feedforward=forward)
    samples: list[JointSample] = []
    driver = SimulatedArm(arm.plant())
    try:
        front_end = make_front_end(robot, PipelineSettings())
        ended = run_lockstep(
            driver, front_end, None, controller, seconds_long, each=lambda x, _: samples.append(x)
        )
    finally:
        driver.close()
    if ended.fault is not None:
        raise SystemExit(f"seed {seed}: {ended.fault}")
    q, dq, tau = (np.array([getattr(x, name) for x in samples]) for name in ("q", "dq", "tau"))
    stamps = np.array([x.stamp_ns for x in samples], dtype=np.int64)
    log = Log(Path("rate.mcap"), robot.tree.joint_names, stamps, q, dq, tau)
    if links:
        heard = [x.links for x in samples if x.links is not None]
        twists, accels = (np.array([getattr(x, k) for x in heard]) for k in ("twist", "accel"))
        log = replace(log, link_names=robot.tree.body_names, twists=twists, accels=accels)
    return log, robot


def least_squares(log: Log, until_s: float, robot: SelfModel) -> Array:
    """Held-out error (n,) N m of weighted least squares with friction, offset, motor inertia."""

    def rows(part: Log) -> tuple[Array, Array]:
        q, dq, ddq, tau = smooth(seconds(part), part.q, part.dq, part.tau)
        edge = round(EDGE_S / GRID_S)
        q, dq, ddq, tau = (x[edge:-edge:ROW_EVERY] for x in (q, dq, ddq, tau))
        own = dq, np.tanh(dq / 0.02), np.ones_like(q), ddq
        return with_columns(regressor(robot, q, dq, ddq), own), tau

    early = seconds(log) < until_s
    (X, tau), (held, other) = rows(log.take(early)), rows(log.take(~early))
    weight: Array = np.ones(tau.shape[1])
    for _ in range(3):
        A, b = (X / weight[:, None]).reshape(len(X) * len(weight), -1), (tau / weight).ravel()
        scale = np.maximum(np.linalg.norm(A, axis=0), 1e-9)
        found = np.linalg.lstsq(A / scale, b, rcond=1e-7)[0] / scale
        weight = np.sqrt(np.mean((X @ found - tau) ** 2, axis=0))
    return np.asarray(np.sqrt(np.mean((held @ found - other) ** 2, axis=0)))


def thinned(log: Log, rate: int) -> tuple[Log, PipelineSettings]:
    """Every k-th sample, and how a log of that rate is learned from."""
    thin = log.take(np.arange(len(log)) % max(round(1000 / rate), 1) == 0)
    own, _ = fitted_to(thin, PipelineSettings().filter)
    learner = LearnerSettings(effects=REAL_ARM_EFFECTS)
    return thin, PipelineSettings(filter=own, learner=learner)


def announced_at_rate(log: Log, rate: int, robot: SelfModel) -> dict[str, Any]:
    """When, in s, a change was announced in a log in which nothing changed."""
    thin, settings = thinned(log, rate)
    pipeline = Pipeline(robot, settings)
    signals = thin.stamp_ns, thin.q, thin.dq, thin.tau
    for state in pipeline.front_end.step_table(*signals):
        pipeline.learner.step(state)
    learner, begin_ns = pipeline.learner, thin.stamp_ns[0]
    changes = [round(1e-9 * (stamp_ns - begin_ns), 3) for stamp_ns in learner.changes]
    return {"rate": rate, "changes": changes, "looked_at": learner.change.samples}


def friction(theta: Theta) -> Array:
    """Friction (n,) N m of each joint at SPEED, by the effects learned."""
    viscous, coulomb = (
        theta.effect_values[REAL_ARM_EFFECTS.index(name)]
        for name in ("viscous_friction", "bristle_friction")
    )
    return np.asarray(SPEED * viscous + coulomb)


def inertia(theta: Theta, robot: SelfModel, poses: Array) -> Array:
    """Inertia (n,) kg m² about each joint's axis with its motor's, mean over poses (m, n)."""
    own = np.empty(poses.shape[1])
    still = np.zeros_like(poses)
    weight = regressor(robot, poses, still, still)
    for j, turning in enumerate(np.eye(len(own))):
        more = regressor(robot, poses, still, still + turning) - weight
        own[j] = np.mean(more[:, j] @ theta.theta.ravel())
    return np.asarray(own + theta.effect_values[REAL_ARM_EFFECTS.index("motor_inertia")])


def bias(rows: list[dict[str, Any]], what: str) -> dict[int, tuple[float, float]]:
    """By rate: median and worst share by which `what` is off from the fastest rate's."""
    off: dict[int, list[float]] = {}
    for row in rows:
        fastest = max((x for x in rows if x["seed"] == row["seed"]), key=lambda x: int(x["rate"]))
        off.setdefault(row["rate"], []).extend(
            np.abs(np.array(row[what]) / np.array(fastest[what]) - 1.0)
        )
    return {rate: (float(np.median(x)), float(np.max(x))) for rate, x in off.items()}


def at_rate(log: Log, rate: int, robot: SelfModel, every: int) -> dict[str, Any]:
    """What is learned from every k-th sample."""
    thin, settings = thinned(log, rate)
    until_s = 0.75 * float(seconds(log)[-1])
    done = replay(thin, robot, settings, ReplayOptions(every, until_s))
    outcome, learner = done.outcome, done.pipeline.learner
    model = learned_model(outcome, robot)
    late = thin.take(seconds(thin) >= until_s)
    signals = seconds(late), late.q, late.dq, late.tau
    error = rms_of([validation_error(*signals, ModelTorque(model))]).value
    best = least_squares(thin, until_s, robot)
    theta = learner.theta
    excess = np.sqrt(theta.variance() / theta.variance(theta.least_squares()))
    freedom = Freedom.of(np.eye(6) - outcome.lam_identifiable, outcome.lam[:, 3:])
    turn, shift = frame_errors(completed_lambda(outcome, robot)[0], robot.lam, freedom)
    return {
        "rate": rate,
        "over_ls": (error / best).round(3).tolist(),
        "error_nm": error.round(4).tolist(),
        "over_same_moments": excess.round(3).tolist(),
        "lam_converged": bool(outcome.lam_converged),
        "theta_converged": bool(learner.theta_converged),
        "changes": len(learner.changes),
        "lam_rad": float(turn.max()),
        "lam_m": float(shift.max()),
        "friction_nm": friction(theta).round(4).tolist(),
        "inertia_kgm2": inertia(theta, robot, thin.q[:: len(thin) // 100]).round(5).tolist(),
        "refused": dict(done.pipeline.front_end.refused),
    }


def rows_of(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Of each seed and rate what the command line asked for."""
    for seed in range(asked.first, asked.first + asked.trials):
        recipe = Recipe(asked.seconds, asked.slower, asked.links)
        if asked.unchanged:
            slower = asked.slower * (SLOWER_UNCHANGED if seed % 2 else 1.0)
            recipe = recipe._replace(slower=slower, rest_every=4.0)
        log, robot = recorded(seed, recipe)
        for rate in asked.rates:
            if asked.unchanged:
                yield {"seed": seed, **announced_at_rate(log, rate, robot)}
            else:
                yield {"seed": seed, **at_rate(log, rate, robot, asked.every)}


def main() -> None:
    parser = options(__doc__, trials=5, first=200, seconds=40.0, every=1)
    add = parser.add_argument
    add("--rates", type=int, nargs="+", default=RATES)
    add("--slower", type=float, default=1.0, help="than usual")
    add("--links", action="store_true", help="links are measured")
    add("--unchanged", action="store_true", help="count changes announced in logs without any")
    asked = parser.parse_args()
    rows = told(rows_of(asked), asked.json)
    for what in () if asked.unchanged else ("friction_nm", "inertia_kgm2"):
        for rate, (median, worst) in bias(rows, what).items():
            print(f"{what} at {rate} Hz: off by {median:.1%} (median), {worst:.1%} (worst joint)")


if __name__ == "__main__":
    main()
