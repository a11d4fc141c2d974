"""Twins of real logs are what they say: ragged, of an arm with a load, and the same every time."""

import numpy as np
import pytest

from sim.hidden.twins import STEP_S, draw_twin
from tests.helpers.gap_effects import rnea
from tests.helpers.twin_makers import by_mujoco, by_pinocchio

SEEDS = range(12)


def test_logs_are_short_and_ragged():
    for seed in SEEDS:
        recording = by_pinocchio(draw_twin(seed))
        step = 1e-9 * np.diff(recording.stamp_ns)
        repeats = (np.diff(np.hstack([recording.q, recording.tau]), axis=0) == 0).all(axis=1)
        assert 1.9 < step.sum() < 7.0
        assert step.min() > 0.69e-3 and 2 <= (step > 17e-3).sum() <= 8 and step.max() < 62e-3
        assert 0.03 < repeats.mean() < 0.40


def test_draws_are_what_is_said_and_repeat():
    twins = [draw_twin(seed) for seed in range(60)]
    assert {twin.kind for twin in twins} == {"points", "sines", "hand"}
    masses = np.array([twin.load_kg for twin in twins])
    assert 8 < (masses == 0).sum() < 30 and masses.max() < 4.4 and masses[masses > 0].min() > 0.3
    again = draw_twin(7)
    assert (again.q == twins[7].q).all() and (again.arm.theta == twins[7].arm.theta).all()
    limits = again.nominal.limits
    for twin in twins:
        assert (twin.q > limits.lower).all() and (twin.q < limits.upper).all()
        assert (np.abs(twin.motion[1]) < limits.velocity).all()


@pytest.mark.parametrize("seed", [0, 5])
def test_both_simulators_make_the_same_log(seed):
    """Up to how well a controller follows, the torque of the drawn motion."""
    twin = draw_twin(seed)
    ours, theirs = by_pinocchio(twin), by_mujoco(twin)
    assert (ours.stamp_ns == theirs.stamp_ns).all()
    np.testing.assert_allclose(theirs.q, ours.q, atol=0.05)
    off = np.sqrt(np.square(theirs.tau - ours.tau).mean(axis=0))
    assert (off < 0.25 * np.abs(ours.tau).max(axis=0) + 0.3).all()


def test_a_load_pulls_at_the_hand():
    """The torque that the load adds is what its mass at its centre weighs, at rest."""
    twin = draw_twin(11)
    q, still = twin.q[:1], np.zeros((1, 7))
    bare = twin.arm.theta.copy()
    bare[-1] -= np.r_[twin.load_kg, twin.load_kg * twin.load_at, np.zeros(6)]
    more = rnea(twin.arm, q, still, still)
    more -= rnea(twin.arm.with_changes(theta=bare), q, still, still)
    arms = np.abs(more).max() / (9.81 * twin.load_kg)
    assert 0.1 < arms < 1.0  # m: what a load in the hand hangs on, in a ready posture


def test_bristles_hold_and_slide():
    twin = draw_twin(3)
    friction = twin.friction
    slide = np.full((1000, 7), 0.3)
    torque = friction.along(slide, STEP_S)[-1]
    drop = (friction.stiction - friction.coulomb) * np.exp(-np.square(0.3 / friction.speed))
    np.testing.assert_allclose(torque, friction.coulomb + drop + 0.3 * friction.viscous, rtol=1e-6)
    held = friction.along(np.zeros((5, 7)), STEP_S)
    np.testing.assert_allclose(held, np.tile(friction.start * friction.coulomb, (5, 1)))
