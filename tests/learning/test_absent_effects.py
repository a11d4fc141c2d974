"""Friction is looked for on every foreign log; where there is none, looking must cost nothing."""

from dataclasses import replace

import numpy as np
import pytest

from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.torque import ModelTorque
from adapter.learning.learner import OnlineLearner
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
    for gain, effect in zip(learner.theta.effect_values, learner.theta.effects, strict=True):
        tau = tau + gain * effect.column(JointSignals(q, dq, ddq))
    return float(np.sqrt(np.mean((tau - rnea(pin_model(arm()), q, dq, ddq)) ** 2)))


def test_what_is_not_there_fades() -> None:
    plain, looking = learned(()), learned(REAL_ARM_EFFECTS, rows=1)  # spreads adapt by the update
    theta = looking.theta
    widest = np.array([effect.prior_std for effect in theta.effects])
    assert (theta.effect_spread < 0.02 * widest).all()
    assert np.abs(theta.effect_values[:3]).max() < 0.02
    assert theta.model_variance == pytest.approx(0.001**2)
    assert held_out_error(looking) < 1.25 * held_out_error(plain)


def test_what_is_there_stays() -> None:
    theta = learned(REAL_ARM_EFFECTS, friction=True).theta
    assert 0.2 < theta.effect_spread[1] < 0.5
    assert np.allclose(theta.effect_values[1], 0.3, atol=0.05)
    assert theta.model_variance > 0.001**2
