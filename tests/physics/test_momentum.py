"""Momentum, its rates and the torque of weight, held to Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from adapter.physics.kernels import frames_of, momenta
from tests.helpers.robot_models import (
    MACHINES,
    pin_model,
    places_of,
    read_quietly,
    set_angles,
    urdf_text,
)


@pytest.mark.parametrize("robot", ["panda", "mixed17", *MACHINES])
def test_momenta_agree_with_pinocchio(robot: str) -> None:
    """With dM/dt = C + Cᵀ: dp/dt = tau - g + Cᵀ dq."""
    rng = np.random.default_rng(len(robot))
    model, arm = read_quietly(urdf_text(robot)), pin_model(urdf_text(robot))
    data, names = arm.createData(), model.tree.joint_names
    q, dq = rng.normal(size=(2, model.tree.n))
    out = np.empty((3, model.tree.n))
    momenta(frames_of(model.tree, model.lam), model.theta, q, dq, model.gravity, out)
    at, places = pin.neutral(arm), places_of(arm, names)
    set_angles(arm, at, names, q)
    speed = np.zeros(arm.nv)
    speed[places] = dq
    coriolis = pin.computeCoriolisMatrix(arm, data, at, speed)
    theirs = pin.crba(arm, data, at) @ speed, coriolis.T @ speed
    theirs = *theirs, pin.computeGeneralizedGravity(arm, data, at)
    for mine, other in zip(out, theirs, strict=True):
        assert np.allclose(mine, other[places], atol=1e-8)
