"""Friction is looked for on every foreign log; where there is none, looking must cost nothing."""

from dataclasses import replace

import numpy as np
import pytest

from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.torque import ModelTorque
from adapter.learning.learner import OnlineLearner
from adapter.learning.theta import likely_spread
from tests.helpers.arm_data import (
    Motion,
    arm,
    learner_for,
    panda_model,
    pin_model,
    record,
    rnea,
    rubbing,
    states_of,
    teach,
    trajectory,
)

SECONDS = 15.0


def learned(effects: tuple[str, ...], friction: bool = False, rows: int = 4) -> OnlineLearner:
    truth = rubbing(0.3, 0.05) if friction else arm()
    return teach(learner_for(effects=effects), states_of(record(truth, Motion(SECONDS))), rows)


def held_out_error(learner: OnlineLearner) -> float:
    """Torque error on a motion that was not learned from, effects included, N m rms."""
    q, dq, ddq = (x[::20] for x in trajectory(Motion(10.0, seed=99)))
    model = ModelTorque(replace(panda_model(), theta=learner.theta.theta))
    tau = model(q, dq, ddq)
    at = JointSignals(q, dq, ddq)
    for gain, column in zip(
        learner.theta.effect_values, learner.theta.torque_per_unit(at), strict=True
    ):
        tau = tau + gain * column
    return float(np.sqrt(np.mean((tau - rnea(pin_model(arm()), q, dq, ddq)) ** 2)))


def test_what_is_not_there_fades() -> None:
    plain, looking = learned(()), learned(REAL_ARM_EFFECTS, rows=1)  # spreads adapt by the update
    theta = looking.theta
    widest = np.array([effect.learned_std for effect in theta.effects])
    by_rates = np.array([effect.by_rates for effect in theta.effects])  # these do not act at all
    assert (theta.effect_spread < 0.02 * widest)[~by_rates].all()
    assert np.abs(theta.effect_values[:3]).max() < 0.02
    assert np.abs(theta.effect_values[by_rates]).max() < 1e-6
    assert theta.model_variance == pytest.approx(0.001**2)
    assert held_out_error(looking) < 1.25 * held_out_error(plain)


def test_what_is_there_stays() -> None:
    theta = learned(REAL_ARM_EFFECTS, friction=True).theta
    assert 0.2 < theta.effect_spread[1] < 0.5
    assert np.allclose(theta.effect_values[1], 0.3, atol=0.05)
    assert theta.model_variance > 0.001**2


def under(spread: float, x: np.ndarray, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and variances of numbers that data alone say are x, with so much information."""
    variance = 1.0 / (1.0 / spread**2 + data)
    return x * data * variance, variance


@pytest.mark.parametrize("true", [0.3, 0.1])
def test_the_spread_is_the_likeliest(true: float) -> None:
    rng = np.random.default_rng(4)
    data = rng.uniform(200.0, 2000.0, 40)
    x = rng.normal(size=40) * np.hypot(true, 1.0 / np.sqrt(data))
    found = 1.0
    for _ in range(3):
        found = likely_spread(*under(found, x, data), found)
    grid = np.geomspace(1e-3, 1.0, 2000)
    level = grid[:, None] ** 2 + 1.0 / data
    cost = (np.log(level) + x**2 / level).sum(axis=1)
    assert found == pytest.approx(grid[np.argmin(cost)], rel=0.01)


def test_one_look_takes_most_of_its_share_from_an_absent_effect() -> None:
    """It was a standard deviation of the data wide after the first look, and a second later 0.7."""
    data = np.full(7, 1e4)
    assert likely_spread(*under(1.0, np.zeros(7), data), 1.0) < 0.15 / 100.0


def test_what_begins_after_it_faded_is_found() -> None:
    data, x, found = np.full(7, 1e4), np.full(7, 0.3), 1e-3
    for _ in range(2):
        found = likely_spread(*under(found, x, data), found)
    assert found == pytest.approx(0.3, rel=0.01)
