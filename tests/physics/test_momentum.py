"""Momentum, its rates and the torque of weight, held to Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from adapter.physics.kernels import frames_of, momenta
from sim.truth import panda
from tests.helpers.arm_data import panda_model, pin_model


@pytest.mark.parametrize("seed", range(5))
def test_momenta_agree_with_pinocchio(seed: int) -> None:
    """With dM/dt = C + Cᵀ: dp/dt = tau - g + Cᵀ dq."""
    rng = np.random.default_rng(seed)
    truth, model = panda(), panda_model()
    arm = pin_model(truth)
    data = arm.createData()
    q, dq = rng.normal(size=(2, 7))
    out = np.empty((3, 7))
    momenta(frames_of(model.tree.parent, model.lam), model.theta, q, dq, model.gravity, out)
    mass = pin.crba(arm, data, q)
    coriolis = pin.computeCoriolisMatrix(arm, data, q, dq)
    assert np.allclose(out[0], mass @ dq, atol=1e-9)
    assert np.allclose(out[1], coriolis.T @ dq, atol=1e-9)
    assert np.allclose(out[2], pin.computeGeneralizedGravity(arm, data, q), atol=1e-9)
