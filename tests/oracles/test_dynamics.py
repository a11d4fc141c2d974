"""The dynamics network and the regressor against Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import torch
from robot_models import ROBOTS, pin_model, pinocchio_case, relative, urdf_text

from adapter.dynamics import DynamicsNetwork, inverse_dynamics, regressor
from adapter.kinematics import DTYPE, KinematicsNetwork, Motion, link_motion
from adapter.tree import Tree

# Pinocchio's order of inertia elements [XX XY YY XZ YZ ZZ] in ours [XX XY XZ YY YZ ZZ].
_TO_OURS = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]


@pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_torques_are_pinocchios(robot: str, floating: bool) -> None:
    case = pinocchio_case(urdf_text(robot), floating)
    model = case.model
    lam, theta = torch.from_numpy(model.lam), torch.from_numpy(model.theta)
    signals = (case.q, case.dq, case.ddq, case.base)
    assert relative(inverse_dynamics(model.tree, lam, theta, *signals), case.tau) < 1e-9
    y = regressor(model.tree, lam, *signals)
    assert y.shape == (len(case.q), model.tree.rows, 10 * model.tree.bodies)
    assert relative(y @ theta.reshape(-1), case.tau) < 1e-9


def test_regressor_of_the_panda_is_pinocchios() -> None:
    """Entry by entry: all axes of the Panda are z, so the frames are the same."""
    text = urdf_text("panda")
    case = pinocchio_case(text, floating=False)
    mine = regressor(
        case.model.tree, torch.from_numpy(case.model.lam), case.q, case.dq, case.ddq, case.base
    )
    oracle = pin_model(text)
    data = oracle.createData()
    columns = np.concatenate([10 * k + np.array(_TO_OURS) for k in range(7)])
    for k in range(len(case.q)):
        state = (case.q[k].numpy(), case.dq[k].numpy(), case.ddq[k].numpy())
        theirs = pin.computeJointTorqueRegressor(oracle, data, *state)[:, columns]
        assert relative(mine[k], theirs) < 1e-9


def test_networks_compose_as_the_paper_says() -> None:
    """τ = w ∘ k (eq. 5c), and the base wrench carries the whole robot's weight at rest."""
    case = pinocchio_case(urdf_text("tree5"), floating=True)
    model = case.model
    kinematics = KinematicsNetwork(model.tree, torch.from_numpy(model.lam))
    dynamics = DynamicsNetwork(model.tree, torch.from_numpy(model.theta))
    k = kinematics(case.q, case.dq, case.ddq, case.base)
    assert relative(dynamics(kinematics.lam, case.q, k).detach(), case.tau) < 1e-9

    still = torch.zeros_like(case.q)
    zero = torch.zeros(len(still), 3, dtype=DTYPE)
    base = Motion(zero, zero, torch.tensor([0, 0, 9.81], dtype=DTYPE).expand_as(zero), zero)
    k = kinematics(case.q, still, still, base)
    weight = dynamics.wrenches(kinematics.lam, case.q, k)[:, 0, :3].detach().numpy()
    np.testing.assert_allclose(
        weight, np.tile([0, 0, 9.81 * model.theta[:, 0].sum()], (len(still), 1)), atol=1e-9
    )


@pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])
def test_gradients(floating: bool) -> None:
    """gradcheck over λ, θ, joint signals and the base's motion."""
    torch.manual_seed(0)
    tree = Tree((-1, 0, 0), floating)
    signals = [torch.randn(2, tree.n, dtype=DTYPE, requires_grad=True) for _ in range(3)]
    lam = torch.randn(tree.n, 6, dtype=DTYPE, requires_grad=True)
    theta = torch.randn(tree.bodies, 10, dtype=DTYPE, requires_grad=True)
    base = [torch.randn(2, 3, dtype=DTYPE, requires_grad=True) for _ in range(4)]

    def run(lam, theta, q, dq, ddq, *base):  # type: ignore[no-untyped-def]
        return inverse_dynamics(tree, lam, theta, q, dq, ddq, Motion(*base))

    def run_regressor(lam, q, dq, ddq, *base):  # type: ignore[no-untyped-def]
        return regressor(tree, lam, q, dq, ddq, Motion(*base))

    assert torch.autograd.gradcheck(run, (lam, theta, *signals, *base))
    assert torch.autograd.gradcheck(run_regressor, (lam, *signals, *base), fast_mode=True)


def test_gradient_of_theta_is_the_regressor() -> None:
    case = pinocchio_case(urdf_text("panda"), floating=False, samples=1)
    lam = torch.from_numpy(case.model.lam)
    network = DynamicsNetwork(case.model.tree)
    k = link_motion(case.model.tree, lam, case.q, case.dq, case.ddq, case.base)
    network(lam, case.q, k)[0, 3].backward()
    y = regressor(case.model.tree, lam, case.q, case.dq, case.ddq, case.base)
    assert network.theta.grad is not None
    assert relative(network.theta.grad.reshape(-1), y[0, 3]) < 1e-12
