"""θ comes back: as good as batch least squares, possible at every step, effects told apart."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from adapter.effects.torque import ModelTorque
from adapter.learning.learner import OnlineLearner
from adapter.model.inertia import min_eigenvalue
from adapter.model.self_model import SelfModel, Tool
from adapter.physics.kernels import JointMotion, base_at_rest, placed, regressors
from adapter.runs.outcome import collect, learned_model
from adapter.signals.records import StateLayout
from sim.scenarios import build
from tests.helpers.arm_data import (
    ArmData,
    Motion,
    arm,
    learner_for,
    model_torque,
    panda_model,
    record,
    rms,
    states_of,
    teach,
)

N = 7
SECONDS = 15.0
LOOK_EVERY = 5  # samples
SEEDS = (1, pytest.param(2, marks=pytest.mark.slow))
FRICTION = ("viscous_friction", "coulomb_friction", "torque_offset", "motor_inertia")
AT = StateLayout(N)


def learn(
    data: ArmData, model: SelfModel | None = None, **settings
) -> tuple[OnlineLearner, np.ndarray]:
    """The learner after a recording, and the smallest pseudo-inertia eigenvalue on the way."""
    learner, states = learner_for(model, **settings), states_of(data, model)
    smallest = []
    for k in range(0, len(states), LOOK_EVERY):
        teach(learner, states[k : k + LOOK_EVERY], rows=1)
        smallest.append(min_eigenvalue(learner.theta.theta).min())
    return learner, np.array(smallest)


@cache
def plain(seed: int) -> tuple[OnlineLearner, np.ndarray, ArmData]:
    data = record(arm(), Motion(SECONDS, seed))
    return (*learn(data, seed=seed), data)


def held_out(seed: int, truth=None) -> ArmData:
    """Motion of another seed, without noise."""
    return record(truth or arm(), Motion(6.0, 100 + seed), noisy=False)


def held_out_rms(
    learner: OnlineLearner, theta: np.ndarray, data: ArmData, model=None
) -> np.ndarray:
    q, dq, ddq, tau = data.true
    return rms(tau - model_torque(model or panda_model(), learner.schema.lam, theta, q, dq, ddq))


def batch_theta(learner: OnlineLearner, data: ArmData) -> np.ndarray:
    """Weighted batch least squares on the same filtered states, by numpy alone."""
    table = states_of(data)[::8]
    q, dq, ddq, tau = (np.ascontiguousarray(table[:, k]) for k in (AT.q, AT.dq, AT.ddq, AT.tau))
    frames = placed(learner.tree, learner.schema.R0, learner.schema.p)
    Y = np.empty((len(q), N, 10 * N))
    regressors(frames, JointMotion(q, dq, ddq), base_at_rest(panda_model().gravity)[None], Y)
    theta, weight = np.zeros(10 * N), np.ones(N)
    for _ in range(2):
        A = (weight[:, None] * Y).reshape(-1, 10 * N)
        # the data don't tell more than base parameters; 1e-6 leaves out what they don't
        theta = np.linalg.lstsq(A, (weight * tau).ravel(), rcond=1e-6)[0]
        weight = 1.0 / rms(tau - Y @ theta)
    return theta.reshape(N, 10)


@pytest.mark.parametrize("seed", SEEDS)
def test_as_good_as_batch_least_squares_and_a_possible_body_at_every_step(seed: int) -> None:
    learner, smallest, data = plain(seed)
    assert (smallest > 0.0).all() and learner.schema.converged
    assert learner.theta_started_ns is not None
    assert 0.2e9 < learner.theta_started_ns < 3e9
    fresh = held_out(seed)
    ours = held_out_rms(learner, learner.theta.theta, fresh)
    theirs = held_out_rms(learner, batch_theta(learner, data), fresh)
    noise = np.sqrt(learner.theta.variance())
    assert np.linalg.norm(ours / noise) < 1.1 * np.linalg.norm(theirs / noise)
    own = learner.theta.least_squares()[: 10 * N].reshape(N, 10)
    assert np.linalg.norm(ours / noise) < 1.1 * np.linalg.norm(
        held_out_rms(learner, own, fresh) / noise
    )
    assert (ours < 0.05 * rms(fresh.true[3])).all()


def test_theta_waits_for_lambda() -> None:
    waiting = teach(learner_for(), states_of(plain(1)[2])[:100], rows=1)
    assert waiting.theta_started_ns is None and waiting.theta.count == 0
    model = learned_model(collect(waiting), panda_model())
    assert not model.theta_identifiable.any() and np.isnan(model.theta_std).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_standard_deviations_are_of_the_size_of_the_errors(seed: int) -> None:
    """Of the torques on held-out motion: predicted spread against what is off.

    The torque noise is not white within the band, so a factor of two is let through.
    """
    learner, _, _ = plain(seed)
    q, dq, ddq, tau = held_out(seed).true
    q, dq, ddq, tau = (x[500::40] for x in (q, dq, ddq, tau))
    error = tau - model_torque(panda_model(), learner.schema.lam, learner.theta.theta, q, dq, ddq)
    columns = np.array(
        [
            model_torque(panda_model(), learner.schema.lam, unit.reshape(N, 10), q, dq, ddq)
            for unit in np.eye(10 * N)
        ]
    )
    covariance = learner.theta.covariance()[: 10 * N, : 10 * N]
    spread = np.sqrt(np.einsum("amj,ab,bmj->mj", columns, covariance, columns))
    z = rms((error / spread).reshape(-1, 1))[0]
    assert 0.3 < z < 2.5


@cache
def with_friction(seed: int) -> OnlineLearner:
    truth = build("friction", seed).truth
    learner = learner_for(seed=seed, effects=FRICTION)
    return teach(learner, states_of(record(truth, Motion(12.0, seed))))


@pytest.mark.parametrize("seed", SEEDS)
def test_friction_comes_back_within_its_std(seed: int) -> None:
    learner, truth = with_friction(seed), build("friction").truth
    k = 10 * (N + 1)
    std = np.sqrt(learner.theta.covariance().diagonal()[k:]).reshape(-1, N)
    values = learner.theta.effect_values
    expected = np.zeros((4, N))
    for effect in truth.effects:
        row, key = {"viscous_friction": (0, "Fv"), "coulomb_friction": (1, "Fc")}[effect.name]
        expected[row, effect.columns(N)] = effect.number(key)
    z = (values - expected) / std
    assert np.abs(z[:3]).max() < 4.0
    assert np.sqrt(np.mean(z[:3] ** 2)) < 2.0
    assert (np.abs(values - expected)[1] < 0.15 * expected[1] + 0.02).all()


def test_effects_are_told_in_the_model() -> None:
    learner = with_friction(1)
    model = learned_model(collect(learner), panda_model())
    assert len(model.effects) == len(FRICTION) * N
    entry = next(e for e in model.effects if e["effect"] == "coulomb_friction")
    assert entry["joints"] == [1] and set(entry["parameters"]) == {"Fc"}
    truth = build("friction").truth
    fresh = held_out(1, truth)
    q, dq, ddq, tau = fresh.true
    noise = np.sqrt(learner.theta.variance())
    assert (rms(tau - ModelTorque(model)(q, dq, ddq)) < 3.0 * noise).all()


TOOL = Tool(1.2, np.array([0.02, -0.01, 0.15]), np.diag([0.004, 0.004, 0.002]))


def tool_torque(data: ArmData) -> np.ndarray:
    """What the tool adds to the torques."""
    load = np.zeros((N, 10))
    load[-1] = TOOL.theta()
    return model_torque(panda_model(), panda_model().lam, load, *data.true[:3])


def loaded(known: bool) -> OnlineLearner:
    """The same motion with a tool that is known or not."""
    data = record(arm(), Motion(6.0, 3))
    model = replace(panda_model(), tool=TOOL) if known else panda_model()
    equipped = replace(data, tau=data.tau + tool_torque(data))
    return teach(learner_for(model), states_of(equipped, model))


def test_a_known_tool_is_kept_apart() -> None:
    """θ of the bare arm comes out the same, with the tool on and known, or without it."""
    bare = teach(learner_for(), states_of(record(arm(), Motion(6.0, 3))))
    equipped = loaded(known=True)
    fresh = held_out(3)
    a = held_out_rms(bare, bare.theta.theta, fresh)
    b = held_out_rms(equipped, equipped.theta.theta, fresh)
    assert np.allclose(a, b, atol=0.02)
    difference = bare.theta.theta - equipped.theta.theta  # much of it no torque shows
    shown = model_torque(panda_model(), bare.schema.lam, difference, *fresh.true[:3])
    assert (rms(shown) < 0.02).all()
    saved = learned_model(collect(equipped), replace(panda_model(), tool=TOOL))
    tau = fresh.true[3] + tool_torque(fresh)
    assert np.allclose(rms(tau - ModelTorque(saved)(*fresh.true[:3])), b, atol=0.02)


def test_a_tool_that_nobody_knows_of_is_learned_as_part_of_the_arm() -> None:
    learner, fresh = loaded(known=False), held_out(3)
    q, dq, ddq, tau = fresh.true
    found = model_torque(panda_model(), learner.schema.lam, learner.theta.theta, q, dq, ddq)
    more = tool_torque(fresh)
    error = rms(tau + more - found)
    assert (error < 0.1 * rms(more) + 0.02).all()


def test_gravity_of_a_wall_mounted_arm() -> None:
    truth = build("wall_mounted").truth
    model = replace(panda_model(), gravity=truth.gravity)
    learner, smallest = learn(record(truth, Motion(6.0, 4)), model)
    fresh = held_out(4, truth)
    right = held_out_rms(learner, learner.theta.theta, fresh, model)
    assert (right < 0.06 * rms(fresh.true[3]) + 0.02).all()
    assert (smallest > 0.0).all()
    wrong, _ = learn(record(truth, Motion(6.0, 4)))
    worse = held_out_rms(wrong, wrong.theta.theta, fresh)
    assert np.linalg.norm(worse) > 10.0 * np.linalg.norm(right)


def test_mode_sample_runs_and_is_worse() -> None:
    data = record(arm(), Motion(SECONDS, 1)).part(5.0)
    batch, _ = learn(data)
    sample, smallest = learn(data, mode="sample", wait_for_schema=False)
    fresh = held_out(1)
    assert (smallest > 0.0).all()
    ours = np.linalg.norm(held_out_rms(batch, batch.theta.theta, fresh))
    assert np.linalg.norm(held_out_rms(sample, sample.theta.theta, fresh)) > 2.0 * ours


def test_static_friction_is_a_band_of_slow_joints() -> None:
    """0.9 of Coulomb's where a joint rests, at most 0.3 as it moves, nothing where it is fast."""
    learner = learner_for(effects=FRICTION)
    theta = learner.theta
    theta.effect_values[FRICTION.index("coulomb_friction")] = np.arange(N)
    at_rest, slow, fast = theta.static_friction(np.full((3, N), [[0.0], [0.05], [0.5]]))
    np.testing.assert_allclose(at_rest, 0.9 * np.arange(N))
    np.testing.assert_allclose(slow, 0.3 * np.exp(-1.0) * np.arange(N))
    np.testing.assert_allclose(fast, 0.0, atol=1e-12)
