"""Ranks as the literature and the reading notes count them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import torch

from adapter.model.robots import documented
from adapter.model.spatial import exp_rotation, matrix_from_zxz, zxz_from_matrix
from adapter.physics.identifiability import (
    base_parameters,
    frame_jacobian,
    frame_observability,
    numerical_rank,
    random_motion,
)
from adapter.physics.networks import FrameMotion, inverse_dynamics, link_motion, link_step
from tests.helpers.robot_models import MACHINES, pin_model, read_quietly, urdf_text

PANDA = documented("panda")
COLUMNS = (
    lambda q, dq, ddq: dq,  # viscous friction
    lambda q, dq, ddq: np.sign(dq),  # Coulomb friction
    lambda q, dq, ddq: np.ones_like(q),  # torque offset
    lambda q, dq, ddq: ddq,  # motor inertia
)


@pytest.mark.parametrize(("count", "rank"), [(1, 50), (2, 57), (3, 64), (4, 69)])
def test_effects_add_to_the_rank(count: int, rank: int) -> None:
    def extra(q, dq, ddq):  # type: ignore[no-untyped-def]
        blocks = [column(q, dq, ddq)[:, :, None] * np.eye(7) for column in COLUMNS[:count]]
        return np.concatenate(blocks, axis=2)

    assert base_parameters(PANDA.tree, PANDA.lam, PANDA.gravity, extra=extra).rank == rank


def test_what_is_outside_the_base_parameters_moves_no_torque() -> None:
    found = base_parameters(PANDA.tree, PANDA.lam, PANDA.gravity)
    assert found.rank == 43
    np.testing.assert_allclose(found.basis.T @ found.basis, np.eye(43), atol=1e-12)
    change = np.random.default_rng(0).normal(size=70)
    hidden = change - found.basis @ (found.basis.T @ change)
    assert np.linalg.norm(hidden) > 1.0
    motion = (torch.from_numpy(x) for x in random_motion(PANDA.tree, 10, seed=3))
    tau = inverse_dynamics(
        PANDA.tree,
        torch.from_numpy(PANDA.lam),
        torch.from_numpy(hidden.reshape(7, 10)),
        tuple(motion),
        torch.from_numpy(PANDA.gravity),
    )
    assert tau.abs().max() < 1e-10


def test_frames_of_the_panda() -> None:
    """36 of 42; hidden are the ones the notes name."""
    found = frame_observability(PANDA.tree, PANDA.lam, PANDA.gravity)
    assert found.ranks == (2, 4, 6, 6, 6, 6, 6) and found.rank == 36
    assert found.flags[2:].all()
    assert found.flags[0].tolist() == [True, True, False, False, False, False]
    # Joint 2: neither turn nor shift along the axis of joint 1, which is the parent's z.
    assert found.flags[1].tolist() == [True, True, False, True, True, False]


@pytest.mark.parametrize("robot", ["panda", "mixed5", *MACHINES])
@pytest.mark.parametrize("gravity", [[0, 0, -9.81], [9.81, 0, 0], [5.0, -3.0, -7.0]])
def test_frame_ranks_against_numerical_derivatives_of_the_whole_chain(
    robot: str, gravity: list[float]
) -> None:
    """The sum of per-joint ranks is the rank of all link motion over all turns and shifts."""
    arm = read_quietly(urdf_text(robot))
    tree, n = arm.tree, arm.tree.n
    q, dq, ddq = (torch.from_numpy(x) for x in random_motion(tree, 15, seed=5))
    step = 1e-6

    def motion(turns: np.ndarray) -> np.ndarray:
        lam = arm.lam.copy()
        lam[:, :3] = zxz_from_matrix(exp_rotation(turns[:, :3]) @ matrix_from_zxz(lam[:, :3]))
        lam[:, 3:] += turns[:, 3:]
        base = torch.tensor(gravity, dtype=torch.float64)
        k = link_motion(tree, torch.from_numpy(lam), (q, dq, ddq), base)
        return torch.cat(list(k), dim=-1).numpy().ravel()

    columns = []
    for k in range(6 * n):
        turns = np.zeros(6 * n)
        turns[k] = step
        forward, back = motion(turns.reshape(n, 6)), motion(-turns.reshape(n, 6))
        columns.append((forward - back) / (2 * step))
    found = frame_observability(tree, arm.lam, np.array(gravity))
    rank, basis = numerical_rank(np.stack(columns, axis=1), tolerance=1e-6)
    assert found.rank == rank
    whole = np.zeros((6 * n, 6 * n))
    for j in range(n):
        whole[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] = found.projectors[j]
    np.testing.assert_allclose(basis @ basis.T, whole, atol=1e-5)


@pytest.mark.parametrize("slides", [False, True])
def test_frame_jacobian_against_numerical_derivatives(slides: bool) -> None:
    """Equal up to the turn into the parent's axes, which JᵀJ does not see."""
    rng = np.random.default_rng(2)
    parent = rng.normal(size=(4, 1, 3))
    q, dq, ddq = rng.normal(size=(3, 1))
    lam_j = rng.normal(size=6)

    def motion(change: np.ndarray) -> np.ndarray:
        turned = exp_rotation(change[:3]) @ matrix_from_zxz(lam_j[:3])
        lam = torch.from_numpy(np.r_[zxz_from_matrix(turned), lam_j[3:] + change[3:]])
        signals = (torch.from_numpy(x) for x in (q, dq, ddq))
        base = FrameMotion(*(torch.from_numpy(x) for x in parent))
        k = link_step(base, tuple(signals), lam, slides)
        return torch.cat(list(k), dim=1).numpy()[0]

    step = 1e-6 * np.eye(6)
    numerical = np.stack([(motion(s) - motion(-s)) / 2e-6 for s in step], axis=1)
    exact = frame_jacobian(parent.reshape(1, 12), (q, dq), lam_j, slides)
    np.testing.assert_allclose(exact.T @ exact, numerical.T @ numerical, rtol=1e-6)


def pinocchio_rank(text: str, floating: bool, seed: int = 0) -> int:
    """Rank of Pinocchio's torque regressor over random motion."""
    oracle = pin_model(text, floating)
    data = oracle.createData()
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(max(20, 40 * oracle.njoints // oracle.nv + 10)):
        q = pin.integrate(oracle, pin.neutral(oracle), rng.uniform(-3.0, 3.0, oracle.nv))
        v, a = rng.normal(size=oracle.nv), 3.0 * rng.normal(size=oracle.nv)
        rows.append(pin.computeJointTorqueRegressor(oracle, data, q, v, a).copy())
    return numerical_rank(np.concatenate(rows))[0]


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("robot", ["talos", "panda", "tree17", "mixed33", *MACHINES])
def test_base_parameters_are_those_of_pinocchio(robot: str, floating: bool) -> None:
    text = urdf_text(robot)
    model = read_quietly(text, floating)
    assert model.tree.n == pin_model(text).nv  # both move the same joints
    found = base_parameters(model.tree, model.lam, model.gravity)
    assert found.rank == pinocchio_rank(text, floating)
    if floating:
        # every joint that turns adds seven (a Panda 59)
        assert found.rank == 10 + 7 * model.tree.n or any(model.tree.slides)
