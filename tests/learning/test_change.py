"""A load at the hand is noticed and weighed; without one, or at rest, nothing moves."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from adapter.learning.change import ChangeDetector, explained_share
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import ChangeSettings, ThetaSettings
from adapter.runs.library import regressor
from adapter.runs.outcome import changes_at, collect, learned_model
from adapter.signals.records import stamps_of
from sim.scenarios import build
from sim.truth import Truth
from tests.helpers.arm_data import (
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

AT_S = 12.0
MASSES = (0.1, pytest.param(0.3, marks=pytest.mark.slow), 1.0)


@cache
def loaded_arm(mass: float) -> Truth:
    return build("payload_at_20s", mass=mass, t_s=AT_S).truth


def held_out_error(learner: OnlineLearner, truth: Truth, theta: Any = None) -> np.ndarray:
    """By the learner's θ or another one."""
    q, dq, ddq, tau = record(truth, Motion(6.0, 101), noisy=False).true
    theta = learner.theta.theta if theta is None else theta
    return rms(tau - model_torque(panda_model(), learner.schema.lam, theta, q, dq, ddq))


class WithLoad:
    """A learner that gets a load on the way, and what it looked like at four instants."""

    def __init__(self, mass: float) -> None:
        data = record(loaded_arm(mass), Motion(AT_S + 5.2, 1))
        self.learner = learner = learner_for(seed=1)
        states = states_of(data)
        stamps = 1e-9 * stamps_of(states)
        split = int(np.searchsorted(stamps, AT_S - 0.05))
        teach(learner, states[:split], rows=1)
        self.frames = learner.schema.R0.copy(), learner.schema.p.copy()
        self.theta = learner.theta.theta.copy()
        teach(learner, states[split:], rows=1)
        rows = learner.score_trace.rows
        self.time_s, self.error = 1e-9 * rows[:, 0], rows[:, 29:36]


with_load = cache(WithLoad)


@pytest.mark.parametrize("mass", MASSES)
def test_a_load_is_noticed_once_and_soon_and_nothing_else_moves(mass: float) -> None:
    """Torques are right again within a second; λ and what was known of the other links stay."""
    run = with_load(mass)
    (seen_ns,) = run.learner.changes
    assert AT_S - 0.05 < 1e-9 * seen_ns < AT_S + 0.3
    before = (run.time_s > AT_S - 2.0) & (run.time_s < AT_S - 0.1)
    after = (run.time_s > AT_S + 0.8) & (run.time_s < AT_S + 1.0)
    level, now = (np.sqrt(np.mean(run.error[k] ** 2)) for k in (before, after))
    assert now < 1.5 * level
    R0, p = run.frames
    assert np.abs(run.learner.schema.R0 - R0).max() < 1e-6
    assert np.abs(run.learner.schema.p - p).max() < 1e-6
    (load,) = loaded_arm(mass).effects
    on = arm().with_changes(effects=(replace(load, interval_s=None),))
    bare = held_out_error(run.learner, arm(), run.theta)
    assert (held_out_error(run.learner, on) < 2.0 * bare + 0.02).all()


@pytest.mark.parametrize("mass", MASSES)
def test_the_load_is_weighed(mass: float) -> None:
    """Within 5 % after 5 s for 0.3 and 1 kg; 0.1 kg within its std or a fifth."""
    run = with_load(mass)
    outcome, slack = collect(run.learner), 0.05 * mass if mass >= 0.3 else 0.2 * mass
    com = [loaded_arm(mass).effects[0].number(key) for key in ("cx", "cy", "cz")]
    for theta, covariance in (run.learner.theta.payload, outcome.payload):  # as it goes; at the end
        assert theta[0] == pytest.approx(mass, abs=slack)
        assert abs(theta[0] - mass) < 4.0 * np.sqrt(covariance[0, 0]) + 0.01 * mass
        assert np.abs(theta[1:4] / theta[0] - com).max() < (0.02 if mass >= 0.3 else 0.06)
    since = {"what": "payload", "since_s": AT_S + 0.05}
    (told,) = changes_at(outcome.changes_ns, outcome.payload, [since])  # one load, one date
    assert told == {"stamp_s": since["since_s"], "payload": told["payload"]}
    assert told["payload"]["m"] == outcome.payload[0][0]


def test_the_model_knows_the_hand_as_well_as_its_load_is_known() -> None:
    """Its standard deviations are those of the body with the load, not of the bare hand."""
    learner = with_load(1.0).learner
    theta, outcome = learner.theta, collect(learner)
    model = learned_model(outcome, panda_model())
    std = np.sqrt(theta.covariance().diagonal())
    longer = np.sqrt(outcome.covariance.diagonal())[-10:] / std[theta.spare]
    assert np.ptp(longer) < 1e-9 * longer[0] and longer[0] >= 1.0  # noise with memory tells less
    alone = model.theta_identifiable[-1]  # of the others it is that of what torques show
    assert alone.sum() >= 5
    np.testing.assert_allclose(
        model.theta_std[-1][alone], (longer * std[theta.spare])[alone], rtol=0.01
    )
    assert not np.allclose(std[theta.spare], std[theta.hand], rtol=0.02)


@pytest.mark.parametrize("joint", [0, 4, 6])
def test_what_no_hand_carries_is_no_change(joint: int) -> None:
    """A joint that rubs more for half a second: friction of this joint alone."""
    data = record(arm(), Motion(14.0, 11))
    tau = data.tau.copy()
    tau[12_000:12_500, joint] += 0.02 * panda_model().limits.effort[joint]
    learner, doubted = learner_for(seed=11), 0
    for state in states_of(replace(data, tau=tau)):
        learner.step(state)
        doubted += learner.change.waiting
    assert doubted and not learner.changes


def test_what_static_friction_may_hold_is_no_load() -> None:
    """A torque on joint 7 alone: a load's, by the noise; where that joint creeps, friction's."""
    theta = learner_for(effects=("coulomb_friction",)).theta
    theta.effect_values[0] = 0.5
    held = theta.static_friction(np.full((50, 7), 0.01))
    q = np.tile([-0.2, 0.4, -0.4, -1.4, -1.6, 1.4, -1.0], (50, 1))
    load = regressor(panda_model(), q, 0.0 * q, 0.0 * q)[:, :, -10:-6]
    level = np.array([0.06, 0.1, 0.09, 0.5, 0.03, 0.05, 0.02])  # of a motion, N m
    error = np.random.default_rng(1).normal(0.0, 0.4 * level, (50, 7))
    error[:, 6] += 0.25
    sizes = (0.0 * held + level)[..., None], np.hypot(level, held)[..., None]
    share = [explained_share(load / x, error / x[..., 0]) for x in sizes]
    assert share[0] > 0.95 and share[1] < 0.9, share


def test_no_false_alarm() -> None:
    learner = learner_for(seed=11)
    for state in states_of(record(arm(), Motion(14.0, 11))):
        learner.step(state)
        assert not learner.change.waiting
    assert not learner.changes and learner.theta.payload is None


@pytest.mark.parametrize("joint", [0, 6])
def test_directional_forgetting_does_not_wind_up(joint: int) -> None:
    """All joints for 6 s, then one alone for 10 s while 2 s are remembered."""
    motion = Motion(16.0, 5, alone=(joint, 6.0))
    states = states_of(record(arm(), motion))
    learner = learner_for(theta=ThetaSettings(forget_s=2.0))
    split = int(np.searchsorted(1e-9 * stamps_of(states), 6.0))
    middle = held_out_error(teach(learner, states[:split]), arm())
    teach(learner, states[split:])
    noise = np.sqrt(learner.theta.variance())
    end = held_out_error(learner, arm())
    assert np.linalg.norm(end / noise) < 1.5 * np.linalg.norm(middle / noise)
    assert not learner.changes
    moments = [learner.theta.joint_moments(j) for j in range(7)]
    assert all(np.linalg.eigvalsh(a)[0] > -1e-6 * np.abs(a).max() for a in moments)


@pytest.mark.parametrize("forget_s", [None, 2.0])
def test_at_rest_nothing_moves(forget_s: float | None) -> None:
    """Twenty seconds at rest; then the next motion starts where the last ended."""
    data = record(arm(), Motion(28.0, 6, rests=((5.0, 26.0),)))
    states = states_of(data)
    stamps = 1e-9 * stamps_of(states)
    assert not ((stamps > 6.1) & (stamps < 25.9)).any()
    learner = learner_for(theta=ThetaSettings(forget_s=forget_s))
    split = int(np.searchsorted(stamps, 15.0))
    before, lam = held_out_error(teach(learner, states[:split]), arm()), learner.schema.lam
    after = held_out_error(teach(learner, states[split:]), arm())
    noise = np.sqrt(learner.theta.variance())
    assert np.linalg.norm(after / noise) < 1.2 * np.linalg.norm(before / noise)
    assert np.abs(learner.schema.lam[1:, 3:] - lam[1:, 3:]).max() < 1e-4
    assert not learner.changes


def test_a_second_change_is_seen_once_the_first_is_learned_and_not_before() -> None:
    """Behind a change the error is large until the new load is learned; that is no other one."""
    settings = ChangeSettings(fast=20, slow=200, arm_after=500, rearm_after=800, wait=30)
    detector = ChangeDetector(3, settings)
    rng = np.random.default_rng(3)

    def look(samples: int, size: float) -> list[int]:
        errors = size * rng.normal(size=(samples, 1, 3))
        return [k for k, error in enumerate(errors) if detector.look(error)]

    assert look(2000, 1.0) == []
    first = look(300, 8.0)
    assert len(first) == 1 and first[0] < 80
    assert look(200, 1.0) == [] and look(100, 40.0) == []  # not armed again
    assert look(4000, 1.0) == []
    assert len(look(300, 40.0)) == 1
