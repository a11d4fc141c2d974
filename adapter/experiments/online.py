"""The 1 kHz learner on a whole robot: what a sample costs and what is learned by when."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings, SchemaSettings
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.self_model import gravity_down
from adapter.model.spatial import Array
from adapter.physics.identifiability import frame_observability
from adapter.runs.outcome import frame_errors

HELD_OUT_EVERY = 10  # samples
LOOK_EVERY = 5000  # samples between two looks at the errors
PAUSE_NS = 1_000_000_000  # between two motions
# Noise of signals behind a filter, standard deviations: rad, rad/s, rad/s² of joints; rad/s,
# m/s², rad/s² of bodies; share of the torque's own spread.
NOISE_Q, NOISE_DQ, NOISE_DDQ = 2e-5, 1e-3, 2e-2
NOISE_W, NOISE_A, NOISE_DW = 2e-3, 2e-2, 2e-2
NOISE_TAU = 0.01
# A look at 30 frames takes half a millisecond, a sample redone 0.1 ms: less of both than on an arm.
SETTINGS = LearnerSettings(rebuild_rows=3, rebuild_stds=3.0, schema=SchemaSettings(judge_every=20))


def without_velocity(data: TreeData) -> TreeData:
    """The same samples without the links' linear velocity, which no sensor on a link shows."""
    assert data.links is not None
    base, links = (BodyMotion(x.w, x.a, x.dw) for x in (data.base, data.links))
    return TreeData(data.tree, data.q, data.dq, data.ddq, data.tau, base, links)


def noisy(data: TreeData, seed: int) -> TreeData:
    """White noise on all that is measured; the wrench of a free fall stays zero."""
    rng = np.random.default_rng(seed)

    def with_noise(x: Array, std: float | Array) -> Array:
        return x + std * rng.normal(size=x.shape)

    def moving(motion: BodyMotion) -> BodyMotion:
        return BodyMotion(
            with_noise(motion.w, NOISE_W),
            with_noise(motion.a, NOISE_A),
            with_noise(motion.dw, NOISE_DW),
        )

    tau = with_noise(data.tau, NOISE_TAU * data.tau.std(axis=0))
    q, dq, ddq = (
        with_noise(x, std)
        for x, std in ((data.q, NOISE_Q), (data.dq, NOISE_DQ), (data.ddq, NOISE_DDQ))
    )
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
    test = test.take(slice(None, None, HELD_OUT_EVERY))
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
        clock_ns += round(1e6 * len(data)) + PAUSE_NS
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
