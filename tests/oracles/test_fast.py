"""The compiled kernels of the tick against the torch networks and Pinocchio."""

import numpy as np
import pytest
import torch
from robot_models import PANDA, Case, pinocchio_case, random_urdf, relative, urdf_text

from adapter import dynamics, kinematics
from adapter.fast import body_wrench_regressor, link_motion, regressor
from adapter.rigid_arm import rigid_torque
from adapter.robots import documented
from adapter.spatial import matrix_from_zxz
from adapter.torque import ModelTorque
from adapter.tree import Tree
from adapter.twist import base_motion

TOLERANCE = 1e-9
# random trees branch; two_arms hangs two chains on the base
FIXED = ("panda", "lwr4", "tree5", "tree17", "tree33", "two_arms")


def text_of(name: str) -> str:
    return random_urdf(8, seed=3) if name == "two_arms" else urdf_text(name)


@pytest.fixture(scope="module", params=FIXED)
def case(request: pytest.FixtureRequest) -> Case:
    return pinocchio_case(text_of(request.param), floating=False, samples=8, seed=4)


def frames(lam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    R0 = np.ascontiguousarray(matrix_from_zxz(lam[:, :3]))
    return R0, np.ascontiguousarray(lam[:, 3:])


def compiled(tree: Tree, lam, gravity, q, dq, ddq):
    """Motion (m, n, 12) and regressor (m, n, 10 n) by the kernels."""
    parent, (R0, p), base = np.array(tree.parent), frames(lam), base_motion(gravity)
    motion = np.full((len(q), tree.n, 12), np.nan)
    Y = np.full((len(q), tree.n, 10 * tree.n), np.nan)
    for m in range(len(q)):
        link_motion(parent, R0, p, q[m], dq[m], ddq[m], base, motion[m])
        regressor(parent, R0, p, q[m], motion[m], Y[m])
    return motion, Y


def of_case(case: Case):
    signals = [x.numpy() for x in (case.q, case.dq, case.ddq)]
    return compiled(case.model.tree, case.model.lam, case.model.gravity, *signals)


def test_the_trees_branch() -> None:
    for name in ("tree17", "two_arms"):
        tree = pinocchio_case(text_of(name), False, samples=1).model.tree
        children = [tree.parent.count(i) for i in range(-1, tree.n)]
        assert max(children) > 1


def test_link_motion_equals_pinocchio(case: Case) -> None:
    motion, _ = of_case(case)
    for k, part in enumerate(case.motion):
        assert relative(motion[:, :, 3 * k : 3 * k + 3], part) < TOLERANCE


def test_link_motion_equals_the_network(case: Case) -> None:
    motion, _ = of_case(case)
    lam = torch.from_numpy(case.model.lam)
    net = kinematics.KinematicsNetwork(case.model.tree, lam)
    with torch.no_grad():
        parts = net(case.q, case.dq, case.ddq, case.base)
    for k, part in enumerate(parts):
        assert relative(motion[:, :, 3 * k : 3 * k + 3], part) < TOLERANCE


def test_regressor_equals_the_network(case: Case) -> None:
    _, Y = of_case(case)
    lam = torch.from_numpy(case.model.lam)
    theirs = dynamics.regressor(case.model.tree, lam, case.q, case.dq, case.ddq, case.base)
    assert relative(Y, theirs.numpy()) < TOLERANCE


def test_torque_equals_pinocchio(case: Case) -> None:
    _, Y = of_case(case)
    assert relative(Y @ case.model.theta.ravel(), case.tau) < TOLERANCE


def test_torque_of_tables_equals_pinocchio(case: Case) -> None:
    tree, model = case.model.tree, case.model
    tau = np.empty_like(case.tau)
    signals = [x.numpy() for x in (case.q, case.dq, case.ddq)]
    base, theta = base_motion(model.gravity), model.theta.ravel()
    rigid_torque(np.array(tree.parent), *frames(model.lam), base, theta, *signals, tau)
    assert relative(tau, case.tau) < TOLERANCE
    assert relative(ModelTorque(model)(*signals), case.tau) < TOLERANCE


@pytest.mark.parametrize("seed", range(3))
def test_body_wrench_regressor_equals_the_network(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(20, 12))
    parts = kinematics.Motion(*(torch.from_numpy(rows[:, k : k + 3]) for k in (0, 3, 6, 9)))
    ours = np.full((20, 6, 10), np.nan)
    for row, W in zip(rows, ours, strict=True):
        body_wrench_regressor(row, W)
    assert relative(ours, dynamics.body_regressor(parts).numpy()) < 1e-14


@pytest.mark.parametrize("seed", range(3))
def test_any_frames_and_any_gravity(seed: int) -> None:
    """Frames and gravity that no documentation has: what a learner meets on its way."""
    rng = np.random.default_rng(seed)
    n = 9
    tree = Tree(tuple(int(rng.integers(-1, k)) for k in range(n)))
    lam, gravity = rng.normal(size=(n, 6)), rng.normal(size=3) * 9.81
    q, dq, ddq = rng.normal(size=(3, 6, n)) * 3.0
    motion, Y = compiled(tree, lam, gravity, q, dq, ddq)
    signals = [torch.from_numpy(x) for x in (lam, q, dq, ddq, gravity)]
    parts = kinematics.link_motion(tree, *signals)
    for k, part in enumerate(parts):
        assert relative(motion[:, :, 3 * k : 3 * k + 3], part.numpy()) < TOLERANCE
    assert relative(Y, dynamics.regressor(tree, *signals).numpy()) < TOLERANCE


def test_columns_of_other_branches_are_zero() -> None:
    tree = Tree((-1, 0, 0, 1, 2))
    rng = np.random.default_rng(0)
    _, Y = compiled(tree, rng.normal(size=(5, 6)), rng.normal(size=3), *rng.normal(size=(3, 4, 5)))
    blocks = np.abs(Y.reshape(4, 5, 5, 10)).max(axis=(0, 3))
    beyond = np.array([[j in tree.path_to(k) for k in range(5)] for j in range(5)])
    assert (blocks[~beyond] == 0.0).all()
    assert (blocks[beyond] > 0.0).all()


def test_at_rest_an_accelerometer_reads_gravity_upwards() -> None:
    model = documented(PANDA)
    zero = np.zeros((1, 7))
    motion, _ = compiled(model.tree, model.lam, model.gravity, zero, zero, zero)
    assert np.allclose(np.linalg.norm(motion[0, :, 6:9], axis=1), 9.81, rtol=1e-12)
    assert (motion[0, 0, 6:9] == [0.0, 0.0, 9.81]).all()
    assert np.abs(np.delete(motion, [6, 7, 8], axis=2)).max() == 0.0
