"""Rotations and trees hold what they promise, for any input; bodies are Pinocchio's."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.errors import ModelError
from adapter.model.inertia import (
    body_from_theta,
    is_consistent,
    log_cholesky_from_theta,
    min_eigenvalue,
    move_theta,
    pseudo_inertia,
    theta_from_body,
    theta_from_pseudo_inertia,
)
from adapter.model.spatial import (
    exp_rotation,
    log_rotation,
    matrix_from_rpy,
    matrix_from_zxz,
    rot_x,
    rot_z,
    rotation_angle,
    rpy_from_matrix,
    skew,
    vector3,
    z_to_axis,
    zxz_from_matrix,
)
from adapter.model.tree import Tree
from adapter.physics.networks import theta_from_log_cholesky, theta_from_log_cholesky_torch
from tests.helpers.arm_data import PIN_ORDER

# Plain numbers, and those next to every singularity.
edges = st.sampled_from([0.0, np.pi, -np.pi, np.pi / 2, -np.pi / 2, np.pi / 4])
tiny = st.sampled_from([0.0, 1e-16, -1e-13, 1e-11, 1e-8, -1e-6])
angle = st.one_of(st.floats(-7, 7), st.builds(lambda a, b: a + b, edges, tiny))
triple = st.tuples(angle, angle, angle).map(np.array)
quick = settings(deadline=None, max_examples=200)


@quick
@given(triple)
def test_zxz_meets_the_rotation_and_is_canonical(angles: np.ndarray) -> None:
    rotation = matrix_from_zxz(angles)
    found = zxz_from_matrix(rotation)
    np.testing.assert_allclose(matrix_from_zxz(found), rotation, atol=1e-11)
    assert 0 <= found[1] <= np.pi
    mirrored = matrix_from_zxz(angles * [1, -1, 1] + [np.pi, 0, np.pi])
    np.testing.assert_allclose(mirrored, rotation, atol=1e-14)


def test_zxz_at_its_singularity_has_no_gamma() -> None:
    for beta in (0.0, np.pi):
        np.testing.assert_allclose(
            zxz_from_matrix(rot_z(0.3) @ rot_x(beta) @ rot_z(0.4))[2], 0.0, atol=0
        )


@quick
@given(triple)
def test_rpy_meets_the_rotation(angles: np.ndarray) -> None:
    rotation = matrix_from_rpy(angles)
    np.testing.assert_allclose(matrix_from_rpy(rpy_from_matrix(rotation)), rotation, atol=1e-11)


@quick
@given(triple)
def test_log_undoes_exp(vector: np.ndarray) -> None:
    rotation = exp_rotation(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-13)
    back = log_rotation(rotation)
    np.testing.assert_allclose(exp_rotation(back), rotation, atol=1e-11)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    length = np.linalg.norm(vector)
    if length < 3.1:
        np.testing.assert_allclose(back, vector, atol=1e-9)
        assert rotation_angle(np.eye(3), rotation) == pytest.approx(length, abs=1e-9)


@quick
@given(triple.filter(lambda v: np.linalg.norm(v) > 1e-12))
def test_z_to_axis_is_the_smallest_turn(axis: np.ndarray) -> None:
    turn = z_to_axis(axis)
    unit = axis / np.linalg.norm(axis)
    np.testing.assert_allclose(turn[:, 2], unit, atol=1e-14)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    between = np.arctan2(np.hypot(unit[0], unit[1]), unit[2])
    assert rotation_angle(np.eye(3), turn) == pytest.approx(between, abs=1e-7)


def test_z_to_axis_at_its_ends() -> None:
    np.testing.assert_array_equal(z_to_axis([0, 0, 2]), np.eye(3))
    np.testing.assert_array_equal(z_to_axis([0, 0, -1]), rot_x(np.pi).round())


@given(triple, triple)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


def test_batches() -> None:
    vectors = np.random.default_rng(0).normal(size=(4, 5, 3))
    rotations = exp_rotation(vectors)
    assert rotations.shape == (4, 5, 3, 3)
    np.testing.assert_allclose(log_rotation(rotations), vectors, atol=1e-12)
    np.testing.assert_allclose(matrix_from_zxz(zxz_from_matrix(rotations)), rotations, atol=1e-13)
    with pytest.raises(ValueError, match="3 finite numbers"):
        vector3([1, 2])


parents = st.integers(1, 20).flatmap(
    lambda n: st.tuples(*(st.integers(-1, k - 1) for k in range(n)))
)


@given(parents, st.booleans())
def test_a_tree_knows_its_paths(parent: tuple[int, ...], floating: bool) -> None:
    tree = Tree(parent, floating)
    assert tree.bodies == tree.n + floating and tree.rows == tree.n + 6 * floating
    assert len(tree.body_names) == tree.bodies
    for k in range(tree.n):
        path = tree.path_to(k)
        assert path[-1] == k and parent[path[0]] == -1
        assert all(parent[b] == a for a, b in pairwise(path))
        assert all(parent[c] == k for c in tree.children[k])
    assert sum(map(len, tree.children)) == sum(i >= 0 for i in parent)


def test_trees_name_their_faults() -> None:
    with pytest.raises(ModelError, match="at least one joint"):
        Tree(())
    with pytest.raises(ModelError, match="names must differ"):
        Tree((-1, 0), joint_names=("a", "a"))
    with pytest.raises(ModelError, match="no joint 'x'; have: joint1, joint2"):
        Tree((-1, 0)).joint_index("x")


RNG = np.random.default_rng(3)


def body(oracle: pin.Inertia | pin.LogCholeskyParameters) -> np.ndarray:
    return oracle.toDynamicParameters()[PIN_ORDER]


def test_moving_a_body_is_pinocchios() -> None:
    oracle, place = pin.Inertia.Random(), pin.SE3.Random()
    found = move_theta(body(oracle), place.rotation, place.translation)
    np.testing.assert_allclose(found, body(place.act(oracle)), rtol=1e-11, atol=1e-12)


def test_parameters_are_pinocchios() -> None:
    for _ in range(10):
        oracle = pin.Inertia.Random()
        theta = theta_from_body(oracle.mass, oracle.lever, oracle.inertia)
        np.testing.assert_allclose(theta, body(oracle), rtol=1e-12)
        pseudo = oracle.toPseudoInertia().toMatrix()
        np.testing.assert_allclose(pseudo_inertia(theta), pseudo, atol=1e-12)
        np.testing.assert_allclose(theta_from_pseudo_inertia(pseudo), theta, atol=1e-12)
        mass, com, tensor = body_from_theta(theta)
        np.testing.assert_allclose(mass, oracle.mass)
        np.testing.assert_allclose(com, oracle.lever, atol=1e-12)
        np.testing.assert_allclose(tensor, oracle.inertia, atol=1e-12)


def test_log_cholesky_is_pinocchios() -> None:
    """The same ten numbers in the same order as Rucker and Wensing's, as Pinocchio has them."""
    for _ in range(10):
        vector = RNG.normal(size=10) * 0.7
        theirs = body(pin.LogCholeskyParameters(vector))
        np.testing.assert_allclose(theta_from_log_cholesky(vector), theirs, rtol=1e-12)


@pytest.mark.parametrize("batch", [(), (7,), (3, 4)])
def test_log_cholesky_round_trip(batch: tuple[int, ...]) -> None:
    vector = RNG.normal(size=(*batch, 10))
    theta = theta_from_log_cholesky(vector)
    assert is_consistent(theta)
    np.testing.assert_allclose(log_cholesky_from_theta(theta), vector, atol=1e-10)


def test_log_cholesky_gradient() -> None:
    x = torch.from_numpy(RNG.normal(size=(3, 10))).requires_grad_()
    assert torch.autograd.gradcheck(theta_from_log_cholesky_torch, (x,))


def test_impossible_bodies_are_told() -> None:
    """Positive mass and moments don't make a body: the triangle inequality must hold too."""
    possible = theta_from_body(1.0, np.zeros(3), np.diag([1.0, 1.0, 1.9]))
    broken = theta_from_body(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.1]))
    assert is_consistent(possible) and not is_consistent(broken)
    assert min_eigenvalue(broken) == pytest.approx(-0.05)
    assert is_consistent(broken, tolerance=0.06)
    assert not is_consistent(np.zeros(10)) and not is_consistent(np.full(10, np.nan))
    with pytest.raises(ValueError, match=r"eigenvalue -0\.05"):
        log_cholesky_from_theta(broken)
