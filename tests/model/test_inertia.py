"""Inertial parameters against Pinocchio and against the definition of the pseudo-inertia."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
import torch

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
from adapter.model.spatial import exp_rotation
from adapter.physics.networks import theta_from_log_cholesky, theta_from_log_cholesky_torch
from tests.helpers.arm_data import PIN_ORDER

RNG = np.random.default_rng(3)


def cloud(points: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Point masses: masses (k,) and places (k, 3)."""
    return RNG.uniform(0.1, 1.0, points), RNG.normal(size=(points, 3)) * 0.2


def theta_of_cloud(mass: np.ndarray, place: np.ndarray) -> np.ndarray:
    """θ from its definition: sums over point masses."""
    square = np.einsum("k,ki,kj->ij", mass, place, place)
    i = np.trace(square) * np.eye(3) - square
    six = [i[0, 0], i[0, 1], i[0, 2], i[1, 1], i[1, 2], i[2, 2]]
    return np.array([mass.sum(), *(mass @ place), *six])


def test_pseudo_inertia_is_the_sum_over_points() -> None:
    mass, place = cloud()
    lifted = np.hstack([place, np.ones((len(place), 1))])
    expected = np.einsum("k,ki,kj->ij", mass, lifted, lifted)
    theta = theta_of_cloud(mass, place)
    np.testing.assert_allclose(pseudo_inertia(theta), expected, rtol=1e-12)
    np.testing.assert_allclose(theta_from_pseudo_inertia(expected), theta, rtol=1e-12)


def test_moving_a_body_moves_its_points() -> None:
    mass, place = cloud()
    rotation, position = exp_rotation(RNG.normal(size=3)), RNG.normal(size=3)
    moved = theta_of_cloud(mass, place @ rotation.T + position)
    found = move_theta(theta_of_cloud(mass, place), rotation, position)
    np.testing.assert_allclose(found, moved, rtol=1e-11)


def test_parameters_are_pinocchios() -> None:
    for _ in range(10):
        oracle = pin.Inertia.Random()
        theta = theta_from_body(oracle.mass, oracle.lever, oracle.inertia)
        np.testing.assert_allclose(theta, oracle.toDynamicParameters()[PIN_ORDER], rtol=1e-12)
        np.testing.assert_allclose(
            pseudo_inertia(theta), oracle.toPseudoInertia().toMatrix(), atol=1e-12
        )
        mass, com, tensor = body_from_theta(theta)
        np.testing.assert_allclose(mass, oracle.mass)
        np.testing.assert_allclose(com, oracle.lever, atol=1e-12)
        np.testing.assert_allclose(tensor, oracle.inertia, atol=1e-12)


def test_log_cholesky_is_pinocchios() -> None:
    """The same ten numbers in the same order as Rucker and Wensing's, as Pinocchio has them."""
    for _ in range(10):
        vector = RNG.normal(size=10) * 0.7
        oracle = pin.LogCholeskyParameters(vector)
        theirs = oracle.toDynamicParameters()[PIN_ORDER]
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
