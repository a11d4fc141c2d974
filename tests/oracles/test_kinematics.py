"""The kinematics network against Pinocchio and against numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from robot_models import ROBOTS, pinocchio_case, relative, urdf_text

from adapter.kinematics import DTYPE, KinematicsNetwork, Motion, joint_rotation, link_motion
from adapter.spatial import matrix_from_zxz
from adapter.tree import Tree

BRANCHED = Tree((-1, 0, 0, -1))


@pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_link_motion_is_pinocchios(robot: str, floating: bool) -> None:
    case = pinocchio_case(urdf_text(robot), floating)
    lam = torch.from_numpy(case.model.lam)
    found = link_motion(case.model.tree, lam, case.q, case.dq, case.ddq, case.base)
    for name, mine, theirs in zip(Motion._fields, found, case.motion, strict=True):
        if theirs.abs().max() > 0:
            assert relative(mine, theirs) < 1e-9, name


def test_network_is_the_function_with_lambda_inside() -> None:
    case = pinocchio_case(urdf_text("panda"), floating=False)
    network = KinematicsNetwork(case.model.tree, torch.from_numpy(case.model.lam))
    found = network(case.q, case.dq, case.ddq, case.base)
    assert relative(found.accel().detach(), case.motion.accel()) < 1e-9
    assert relative(found.twist().detach(), case.motion.twist()) < 1e-9
    assert [name for name, _ in network.named_parameters()] == ["lam"]


def test_rotation_of_numpy_and_torch_agree() -> None:
    angles = np.random.default_rng(0).uniform(-4, 4, (20, 3))
    lam = torch.from_numpy(np.hstack([angles, np.zeros((20, 3))]))
    np.testing.assert_allclose(joint_rotation(lam).numpy(), matrix_from_zxz(angles), atol=1e-14)


@pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])
def test_gradients(floating: bool) -> None:
    """gradcheck over λ, joint signals and the base's motion."""
    torch.manual_seed(0)
    tree = Tree(BRANCHED.parent, floating)
    signals = [torch.randn(2, tree.n, dtype=DTYPE, requires_grad=True) for _ in range(3)]
    lam = torch.randn(tree.n, 6, dtype=DTYPE, requires_grad=True)
    base = [torch.randn(2, 3, dtype=DTYPE, requires_grad=True) for _ in range(4)]

    def run(lam, q, dq, ddq, *base):  # type: ignore[no-untyped-def]
        return tuple(link_motion(tree, lam, q, dq, ddq, Motion(*base)))

    assert torch.autograd.gradcheck(run, (lam, *signals, *base))


def test_gradient_reaches_the_parameter_of_the_network() -> None:
    case = pinocchio_case(urdf_text("panda"), floating=False)
    network = KinematicsNetwork(case.model.tree)
    with torch.no_grad():
        network.lam += 0.01 * torch.randn_like(network.lam)
    motion = network(case.q, case.dq, case.ddq, case.base)
    (motion.twist() - case.motion.twist()).square().mean().backward()
    assert network.lam.grad is not None
    assert torch.isfinite(network.lam.grad).all() and network.lam.grad.abs().max() > 0


def test_at_rest_an_accelerometer_reads_the_reaction_to_gravity() -> None:
    """a_0 = -g on a base at rest, whatever way the base is mounted."""
    zero = torch.zeros(1, 1, dtype=DTYPE)
    lam = torch.zeros(1, 6, dtype=DTYPE)
    wall = torch.tensor([9.81, 0.0, 0.0], dtype=DTYPE)
    motion = link_motion(Tree((-1,)), lam, zero, zero, zero, wall)
    np.testing.assert_allclose(motion.a[0, 0].numpy(), [-9.81, 0, 0])
