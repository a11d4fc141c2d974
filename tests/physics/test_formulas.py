"""The formulas: networks against Pinocchio, kernels against both, fixed and floating base."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import torch

from adapter.model.self_model import SelfModel
from adapter.model.tree import Tree
from adapter.physics import kernels, networks
from adapter.physics.kernels import JointMotion, base_at_rest, frames_of
from adapter.physics.networks import FrameMotion
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.arm_data import PIN_ORDER
from tests.helpers.robot_models import (
    MACHINES,
    ROBOTS,
    Case,
    pin_model,
    pinocchio_case,
    places_of,
    random_urdf,
    read_quietly,
    relative,
    set_angles,
    urdf_text,
)

SEEDS = range(6)
floating_or_not = pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])


@floating_or_not
@pytest.mark.parametrize("robot", ROBOTS)
def test_networks_are_pinocchio(robot: str, floating: bool) -> None:
    case = pinocchio_case(urdf_text(robot), floating)
    model = case.model
    lam, theta = torch.from_numpy(model.lam), torch.from_numpy(model.theta)
    given = (case.q, case.dq, case.ddq), case.base
    for mine, theirs in zip(
        networks.link_motion(model.tree, lam, *given), case.motion, strict=True
    ):
        assert (mine - theirs).abs().max() <= 1e-9 * theirs.abs().max()
    assert relative(networks.inverse_dynamics(model.tree, lam, theta, *given), case.tau) < 1e-9
    Y = networks.regressor(model.tree, lam, *given)
    assert Y.shape == (len(case.q), model.tree.rows, 10 * model.tree.bodies)
    assert relative(Y @ theta.reshape(-1), case.tau) < 1e-9


@pytest.mark.parametrize("robot", ["panda", "scara"])
def test_regressor_is_pinocchios(robot: str) -> None:
    """Entry by entry: all their axes are z, so the frames are the same."""
    text = urdf_text(robot)
    case = pinocchio_case(text, floating=False)
    lam = torch.from_numpy(case.model.lam)
    mine = networks.regressor(case.model.tree, lam, (case.q, case.dq, case.ddq), case.base)
    oracle = pin_model(text)
    data = oracle.createData()
    columns = np.concatenate([10 * k + np.array(PIN_ORDER) for k in range(oracle.nv)])
    for k in range(len(case.q)):
        state = (case.q[k].numpy(), case.dq[k].numpy(), case.ddq[k].numpy())
        theirs = pin.computeJointTorqueRegressor(oracle, data, *state)[:, columns]
        assert relative(mine[k], theirs) < 1e-9


@floating_or_not
def test_gradients_of_the_networks(floating: bool) -> None:
    """gradcheck over λ, θ, joint signals and the base's motion."""
    torch.manual_seed(0)
    tree = Tree((-1, 0, 0, -1), floating, slides=(False, True, False, True))
    signals = [torch.randn(2, tree.n, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    lam = torch.randn(tree.n, 6, dtype=torch.float64, requires_grad=True)
    theta = torch.randn(tree.bodies, 10, dtype=torch.float64, requires_grad=True)
    base = [torch.randn(2, 3, dtype=torch.float64, requires_grad=True) for _ in range(4)]

    def motion(lam, q, dq, ddq, *base):  # type: ignore[no-untyped-def]
        return tuple(networks.link_motion(tree, lam, (q, dq, ddq), FrameMotion(*base)))

    def torque(lam, theta, q, dq, ddq, *base):  # type: ignore[no-untyped-def]
        return networks.inverse_dynamics(tree, lam, theta, (q, dq, ddq), FrameMotion(*base))

    def regressor(lam, q, dq, ddq, *base):  # type: ignore[no-untyped-def]
        return networks.regressor(tree, lam, (q, dq, ddq), FrameMotion(*base))

    assert torch.autograd.gradcheck(motion, (lam, *signals, *base))
    assert torch.autograd.gradcheck(torque, (lam, theta, *signals, *base))
    assert torch.autograd.gradcheck(regressor, (lam, *signals, *base), fast_mode=True)


class Random:
    """A tree, frames, bodies and motion that no documentation has, and what the networks say.

    With `moving` the base moves, else it rests under some gravity; a floating base moves.
    """

    def __init__(self, seed: int, floating: bool, moving: bool = True, m: int = 6) -> None:
        rng = np.random.default_rng([seed, floating, moving])
        n = int(rng.integers(2, 12))
        parent = tuple(int(rng.integers(-1, k)) for k in range(n))
        self.tree = Tree(parent, floating, slides=tuple(rng.random(n) < 0.5 * (seed % 2)))
        self.lam, self.theta = rng.normal(size=(n, 6)), rng.normal(size=(self.tree.bodies, 10))
        self.joints = JointMotion(*(3.0 * rng.normal(size=(3, m, n))))
        self.gravity = 9.81 * rng.normal(size=3)
        self.base = base_at_rest(self.gravity)[None]
        base: FrameMotion | torch.Tensor = torch.from_numpy(self.gravity)
        if floating or moving:
            self.base = rng.normal(size=(m, 12))
            base = FrameMotion(*torch.from_numpy(self.base).split(3, dim=1))
        q, dq, ddq = (torch.from_numpy(x) for x in self.joints)
        lam = torch.from_numpy(self.lam)
        self.given = self.tree, lam, (q, dq, ddq), base
        motion = torch.cat(list(networks.link_motion(*self.given)), dim=2)
        self.motion = motion[:, int(floating) :].numpy()
        theta = torch.from_numpy(self.theta)
        self.tau = networks.inverse_dynamics(*self.given[:2], theta, *self.given[2:]).numpy()
        self.Y = networks.regressor(*self.given).numpy()
        self.frames = frames_of(self.tree, self.lam)


@pytest.fixture(params=[(False, False), (False, True), (True, True)], ids=["rest", "moved", "free"])
def randoms(request: pytest.FixtureRequest) -> list[Random]:
    return [Random(seed, *request.param) for seed in SEEDS]


def test_compiled_link_motion_is_the_networks(randoms: list[Random]) -> None:
    for r in randoms:
        out = np.full(r.motion.shape, np.nan)
        kernels.link_motions(r.frames, r.joints, r.base, out)
        for part in (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)):
            assert relative(out[:, :, part], r.motion[:, :, part]) < 1e-9


def test_compiled_torques_and_regressors_are_the_networks(randoms: list[Random]) -> None:
    for r in randoms:
        tau, Y = np.full(r.tau.shape, np.nan), np.full(r.Y.shape, np.nan)
        kernels.torques(r.frames, r.theta, r.joints, r.base, tau)
        kernels.regressors(r.frames, r.joints, r.base, Y)
        assert relative(tau, r.tau) < 1e-9
        assert relative(Y, r.Y) < 1e-9
        others = np.repeat(
            [[j not in r.tree.path_to(k) for k in range(r.tree.n)] for j in range(r.tree.n)],
            10,
            axis=1,
        )
        joints = Y[:, r.tree.rows - r.tree.n :, 10 * (r.tree.bodies - r.tree.n) :]
        assert (joints[:, others] == 0.0).all()


def fixed_case(name: str) -> tuple[Case, SelfModel, list[np.ndarray]]:
    text = random_urdf(8, seed=3) if name == "two_arms" else urdf_text(name)
    case = pinocchio_case(text, floating=False, samples=8, seed=4)
    return case, case.model, [x.numpy() for x in (case.q, case.dq, case.ddq)]


@pytest.mark.parametrize("robot", ["panda", "lwr4", "tree5", "tree17", "two_arms"])
def test_a_rigid_arm_is_pinocchios(robot: str) -> None:
    """Torque and regressor over tables; a changed arm is another one's."""
    case, model, signals = fixed_case(robot)
    arm = RigidArm.of(model)
    assert relative(arm.torque(*signals), case.tau) < 1e-9
    assert relative(arm.regressor(*signals) @ arm.theta.ravel(), case.tau) < 1e-9
    assert arm.torque(*(x[:0] for x in signals)).shape == (0, arm.n)
    turned = arm.changed(theta=2.0 * arm.theta, gravity=np.zeros(3))
    weightless = 2.0 * (case.tau - arm.torque(signals[0], *np.zeros((2, *case.tau.shape))))
    assert relative(turned.torque(*signals), weightless) < 1e-9


@pytest.mark.parametrize("robot", ["panda", "tree17", "two_arms"])
def test_torque_of_a_wrench_is_pinocchios_jacobian(robot: str) -> None:
    _, model, (q, _, _) = fixed_case(robot)
    oracle = pin_model(random_urdf(8, seed=3) if robot == "two_arms" else urdf_text(robot))
    data, wrench = oracle.createData(), np.random.default_rng(5).normal(size=6)
    names = model.tree.joint_names
    last, places = oracle.getJointId(names[-1]), places_of(oracle, names)
    found = RigidArm.of(model).wrench_torque(q, wrench)
    for row, angles in zip(found, q, strict=True):
        full = pin.neutral(oracle)
        set_angles(oracle, full, names, angles)
        pin.computeJointJacobians(oracle, data, full)
        J = pin.getJointJacobian(oracle, data, last, pin.LOCAL_WORLD_ALIGNED)
        assert relative(row, (J.T @ wrench)[places]) < 1e-9


def test_at_rest_an_accelerometer_reads_the_reaction_to_gravity() -> None:
    """a_0 = -g on a base at rest, whatever way the base is mounted; and the base carries all."""
    wall = np.array([9.81, 0.0, 0.0])
    still = torch.zeros(1, 1, dtype=torch.float64)
    motion = networks.link_motion(
        Tree((-1,)), torch.zeros(1, 6, dtype=torch.float64), (still,) * 3, torch.from_numpy(wall)
    )
    assert motion.a[0, 0].tolist() == [-9.81, 0.0, 0.0]
    assert base_at_rest(wall).tolist() == [0.0] * 6 + [-9.81] + [0.0] * 5
    r = Random(4, floating=True)
    tau, q = np.empty((1, r.tree.rows)), r.joints.q[:1]
    up = base_at_rest(np.array([0.0, 0.0, -9.81]))[None]
    kernels.torques(r.frames, r.theta, JointMotion(q, 0 * q, 0 * q), up, tau)
    np.testing.assert_allclose(tau[0, :3], [0, 0, 9.81 * r.theta[:, 0].sum()], atol=1e-9)


@pytest.mark.parametrize("robot", ["panda", "mixed17", *MACHINES])
def test_momenta_agree_with_pinocchio(robot: str) -> None:
    """With dM/dt = C + Cᵀ: dp/dt = tau - g + Cᵀ dq."""
    rng = np.random.default_rng(len(robot))
    model, arm = read_quietly(urdf_text(robot)), pin_model(urdf_text(robot))
    data, names = arm.createData(), model.tree.joint_names
    q, dq = rng.normal(size=(2, model.tree.n))
    out = np.empty((3, model.tree.n))
    kernels.momenta(frames_of(model.tree, model.lam), model.theta, q, dq, model.gravity, out)
    at, places = pin.neutral(arm), places_of(arm, names)
    set_angles(arm, at, names, q)
    speed = np.zeros(arm.nv)
    speed[places] = dq
    coriolis = pin.computeCoriolisMatrix(arm, data, at, speed)
    theirs = pin.crba(arm, data, at) @ speed, coriolis.T @ speed
    theirs = *theirs, pin.computeGeneralizedGravity(arm, data, at)
    for mine, other in zip(out, theirs, strict=True):
        assert np.allclose(mine, other[places], atol=1e-8)
