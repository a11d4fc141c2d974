"""θ's moments follow λ: when λ moves by more than its std they are taken anew."""

from functools import cache

import numpy as np
import pytest

from adapter.learning.learner import OnlineLearner
from adapter.model.spatial import exp_rotation
from tests.helpers.arm_data import Motion, arm, learner_for, panda_model, record, states_of, teach

SECONDS = 6.0


@cache
def states() -> np.ndarray:
    return states_of(record(arm(), Motion(SECONDS, 8)))


def learner_at(truth: bool, **settings) -> OnlineLearner:
    """A learner whose λ stands at the truth, or a little off it, and whose θ begins at once."""
    learner = learner_for(wait_for_schema=False, **settings)
    learner.schema.set_lam(panda_model().lam)
    if not truth:
        rng = np.random.default_rng(2)
        turn = exp_rotation(0.02 * rng.normal(size=(7, 3)))
        learner.schema.R0[:] = learner.schema.R0 @ turn
        learner.schema.p[:] += 0.01 * rng.normal(size=(7, 3))
    return learner


@cache
def learned(truth: bool) -> OnlineLearner:
    return teach(learner_at(truth), states(), rows=1)


def test_moments_are_rebuilt_when_lambda_moves() -> None:
    """λ starts 0.02 rad and 10 mm off and is right soon: θ ends as if it had been all along."""
    off, right = learned(truth=False), learned(truth=True)
    assert off.rebuilds >= 1
    A, B = off.theta.moments.A, right.theta.moments.A
    assert off.theta.count == right.theta.count == len(states())
    assert np.abs(A - B).max() < 1e-5 * np.abs(B).max()
    ours, theirs = (x.theta.least_squares()[:70] for x in (off, right))
    Y = np.abs(ours - theirs)
    assert Y.max() < 0.02
    a, b = (x.theta.variance() for x in (off, right))
    assert np.allclose(a, b, rtol=0.02)


def test_a_lambda_that_stays_rebuilds_nothing_more() -> None:
    learner = learned(truth=False)
    done = learner.rebuilds
    assert teach(learner, states()[-500:], rows=1).rebuilds == done


def test_what_was_held_while_theta_waited_counts_too() -> None:
    learner = teach(learner_for(), states()[:4000], rows=1)
    assert learner.theta_started_ns is not None
    assert learner.rebuilds == 1
    assert learner.theta.count == 4000


def test_only_what_is_held_can_be_rebuilt() -> None:
    learner = teach(learner_at(truth=False, held_samples=1000), states()[:3000], rows=1)
    assert learner.rebuilds >= 1
    assert 1000 <= learner.theta.count <= 3000


@pytest.mark.parametrize("size", [0.0, 1e-6])
def test_a_step_below_the_floor_is_let_be(size: float) -> None:
    learner = teach(learner_at(truth=True), states()[:1500], rows=1)
    done = learner.rebuilds
    learner.schema.p[2, 0] += size
    assert teach(learner, states()[1500:1600], rows=1).rebuilds == done


def test_after_a_change_only_what_came_behind_it_is_rebuilt() -> None:
    """Samples of the old load would pull the new one towards it."""
    learner = teach(learner_at(truth=True), states()[:3000], rows=1)
    done = learner.rebuilds
    learner._start_change(learner.stamp_ns)
    teach(learner, states()[3000:3500], rows=1)
    learner.schema.p[3, 0] += 2e-2
    teach(learner, states()[3500:4500], rows=1)
    assert learner.rebuilds > done and learner._shadow is None
    assert learner.theta.count == 1500
    alone = learner.theta.empty_moments()
    learner.theta.absorb_again(learner.frames, states()[3000:4500], alone)
    A = learner.theta.moments.A
    assert np.abs(A - alone.A).max() < 1e-9 * np.abs(A).max()


def test_moved_is_the_turn_and_shift_between_frames() -> None:
    schema, rng = learner_at(truth=True).schema, np.random.default_rng(1)
    turn, shift = 1e-3 * rng.normal(size=(2, 7, 3))
    R0, p = schema.R0.copy(), schema.p.copy()
    schema.R0[:], schema.p[:] = R0 @ exp_rotation(turn), p + shift
    assert np.allclose(schema.moved_from(R0, p), np.c_[turn, shift], rtol=1e-5, atol=1e-12)
    schema.R0[3] = R0[3] @ exp_rotation(np.array([0.0, 3.1, 0.0]))
    assert np.isinf(schema.moved_from(R0, p)[3, :3]).all()
