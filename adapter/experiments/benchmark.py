"""`adapter bench`: one learning update of ours beside what a user would pick instead."""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.robots import robot_urdf
from adapter.effects.torque import ModelTorque
from adapter.experiments.court import compare
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.learning.theta import Filtered
from adapter.model.inertia import log_cholesky_from_theta
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.networks import inverse_dynamics, link_motion, theta_from_log_cholesky_torch
from adapter.runs.config import PipelineSettings
from adapter.runs.pipeline import make_front_end
from adapter.runs.terminal import print_table, write_json
from adapter.signals.filters import JointFilter
from drivers.interface import JointSample

WARM_UP = 2500  # samples, so that λ has settled and θ is being learned


def run(args: argparse.Namespace) -> int:
    """Carry the command out; returns the exit code."""
    if args.log is not None:
        return compare(args)
    rows, shown = benchmark(max(args.repeats, 10)), []
    for row in rows:
        times = ("-" if row[key] is None else f"{row[key]:.1f}" for key in ("p50_us", "p99_us"))
        shown.append((row["what"], *times, row["note"]))
    print_table(("what", "p50 µs", "p99 µs", "note"), shown)
    write_json(args.json, {"rows": rows})
    return 0


def motion(robot: SelfModel, samples: int) -> tuple[Array, Array, Array, Array]:
    """A smooth motion (m, n) q, dq, ddq and its torque, for timing alone."""
    n = robot.tree.n
    t: Array = 1e-3 * np.arange(samples, dtype=np.float64)[:, None]
    w: Array = 2.0 + 0.7 * np.arange(n, dtype=np.float64)
    middle = 0.5 * (robot.limits.lower + robot.limits.upper)
    q, dq = middle + 0.3 * np.sin(w * t), 0.3 * w * np.cos(w * t)
    ddq = -0.3 * w**2 * np.sin(w * t)
    return q, dq, ddq, ModelTorque(robot)(q, dq, ddq, t[:, 0])


def benchmark(repeats: int) -> list[dict[str, Any]]:
    """One row per contender: what, p50_us, p99_us, note. Contenders not installed say so."""
    torch.set_num_threads(1)
    robot = documented("panda")
    autograd = _autograd(robot, min(repeats, 100))  # it is slow
    return [*_ours(robot, repeats), autograd, _pinocchio(robot, repeats)]


def _row(what: str, times_ns: list[int] | None, note: str) -> dict[str, Any]:
    times = [None, None] if times_ns is None else np.percentile(times_ns, [50, 99]) / 1e3
    return {"what": what, "p50_us": times[0], "p99_us": times[1], "note": note}


def _timed(step: Callable[[Any], object], over: Iterable[Any]) -> list[int]:
    """ns of a step on each of these."""
    times = []
    for x in over:
        before = time.perf_counter_ns()
        step(x)
        times.append(time.perf_counter_ns() - before)
    return times


def _ours(robot: SelfModel, repeats: int) -> list[dict[str, Any]]:
    q, dq, _, tau = motion(robot, WARM_UP + repeats)
    front_end = make_front_end(robot, PipelineSettings())
    samples = [JointSample(1_000_000 * k, q[k], dq[k], tau[k]) for k in range(WARM_UP + repeats)]
    states: list[Array] = []

    def tick(sample: JointSample) -> None:
        states.extend(front_end.step(sample).copy())

    ticks = _timed(tick, samples)[WARM_UP:]
    rows = [_row("front end: checks, filter, twist synthesis", ticks, "per sample")]
    gain = JointFilter().noise_gain
    for effects, note in (((), "λ and θ"), (REAL_ARM_EFFECTS, "λ, θ and a real arm's effects")):
        settings = LearnerSettings(effects=effects)
        learner = OnlineLearner(robot.tree, robot.gravity, settings, Filtered(noise_gain=gain))
        for state in states[: WARM_UP // 2]:
            learner.step(state)
        times = _timed(learner.step, states[WARM_UP // 2 :])
        if learner.theta_started_ns is None:
            note += " (θ had not begun)"
        rows.append(_row("our update from the moments of all samples", times[-repeats:], note))
    return rows


def _autograd(robot: SelfModel, repeats: int) -> dict[str, Any]:
    """The paper's way: one sample, autograd through the torch networks, torch ADAM."""
    q, dq, ddq, tau = (torch.from_numpy(x) for x in motion(robot, repeats))
    lam = torch.tensor(robot.lam, requires_grad=True)
    x = torch.tensor(log_cholesky_from_theta(robot.theta), requires_grad=True)
    gravity = torch.from_numpy(robot.gravity)
    adam = torch.optim.Adam([lam, x], lr=1e-3)
    with torch.no_grad():
        true = link_motion(robot.tree, lam, (q, dq, ddq), gravity)

    def step(k: int) -> None:
        at = slice(k, k + 1)
        joints = q[at], dq[at], ddq[at]
        adam.zero_grad()
        k_hat = link_motion(robot.tree, lam, joints, gravity)
        pairs = ((k_hat.v, true.v), (k_hat.w, true.w), (k_hat.a, true.a))
        cost = torch.stack([((ours - there[at]) ** 2).sum() for ours, there in pairs]).sum()
        theta = theta_from_log_cholesky_torch(x)
        hat = inverse_dynamics(robot.tree, lam.detach(), theta, joints, gravity)
        (cost + ((hat - tau[at]) ** 2).sum()).backward()
        adam.step()

    times = _timed(step, range(repeats))
    return _row("autograd through the torch networks, ADAM", times, "one sample")


def _pinocchio(robot: SelfModel, repeats: int) -> dict[str, Any]:
    """Regressor by Pinocchio, recursive least squares in numpy; θ alone, λ as documented."""
    what = "Pinocchio regressor + recursive least squares"
    if importlib.util.find_spec("pinocchio") is None:
        return _row(what, None, "pin is not installed")
    import pinocchio

    model = pinocchio.buildModelFromXML(robot_urdf(robot, alone=True).text)
    data = model.createData()
    q, dq, ddq, tau = motion(robot, repeats)
    n = model.nv
    P, theta = 1e3 * np.eye(10 * n), np.zeros(10 * n)

    def step(k: int) -> None:
        nonlocal P, theta
        Y = pinocchio.computeJointTorqueRegressor(model, data, q[k], dq[k], ddq[k])
        PY = P @ Y.T
        gain = np.linalg.solve(Y @ PY + np.eye(n), PY.T).T
        theta = theta + gain @ (tau[k] - Y @ theta)
        P = P - gain @ PY.T

    return _row(what, _timed(step, range(repeats)), "θ alone, no λ, no physical consistency")
