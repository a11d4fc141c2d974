"""Rates of the model's torque around each state, and which of the states have to wait for them."""

import numpy as np

from adapter.learning.torque_rates import TorqueRates
from adapter.physics.kernels import base_at_rest
from adapter.physics.rigid_arm import RigidArm
from adapter.signals.records import StateLayout
from tests.helpers.arm_data import Motion, panda_model, trajectory

MODEL, AT = panda_model(), StateLayout(7)
SPAN = 22  # states


def moving() -> tuple[np.ndarray, np.ndarray]:
    """States (m, size) without noise, and the model's torque of them."""
    q, dq, ddq = trajectory(Motion(2.0, seed=3, high_hz=0.5))
    states = AT.new(len(q))
    states[:, 0] = (1_000_000 * np.arange(len(q), dtype=np.int64)).view(np.float64)
    for part, signal in ((AT.q, q), (AT.dq, dq), (AT.ddq, ddq)):
        states[:, part] = signal
    return states, RigidArm.of(MODEL).torque(q, dq, ddq)


def passed(states: np.ndarray, rows: int) -> np.ndarray:
    """What comes out of states that go in so many at a time."""
    arm, rates = RigidArm.of(MODEL), TorqueRates(MODEL.tree, 0.022, 0.0)
    given = (arm.frames.R0, arm.frames.p), arm.theta, base_at_rest(MODEL.gravity)
    parts = [rates.follow(states[k : k + rows], *given).copy() for k in range(0, len(states), rows)]
    return np.concatenate(parts)


def test_rates_of_a_smooth_torque() -> None:
    """One by one as in tables; the newest states wait."""
    states, tau = moving()
    out = passed(states, 1)
    assert len(out) == len(states) - SPAN
    assert np.array_equal(out[:, AT.q], states[:-SPAN, AT.q])
    np.testing.assert_array_equal(out, passed(states, 37))
    rates = out[:, AT.rates].reshape(len(out), 2, 7)
    assert (rates[: SPAN - 1] == 0.0).all()  # nobody knows what came before
    before, here, behind = tau[: -2 * SPAN], tau[SPAN:-SPAN], tau[2 * SPAN :]
    span_s = 1e-3 * SPAN
    first, second = (behind - before) / (2.0 * span_s), (behind - 2.0 * here + before) / span_s**2
    np.testing.assert_allclose(rates[SPAN:, 0], first, atol=1e-8)
    np.testing.assert_allclose(rates[SPAN:, 1], second, atol=1e-6)


def test_a_hole_lets_go_those_that_wait() -> None:
    states, _ = moving()
    states[1000:, 0] = (states[1000:, 0].copy().view(np.int64) + 10**9).view(np.float64)
    out = passed(states, 1)
    assert len(out) == len(states) - SPAN
    around = out[1000 - SPAN : 1000 + SPAN, AT.rates]
    assert (around == 0.0).all() and (out[500:900, AT.rates] != 0.0).all()
