"""Draws from what is known of a model: as wide as it says, together, and bodies that can exist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.errors import ModelError
from adapter.model.inertia import BODY_SIZE, body_from_theta, theta_from_body
from adapter.model.model_file import dumps, loads
from adapter.model.posterior import Posterior, room_of, root_of
from adapter.model.self_model import SelfModel
from adapter.model.spatial import log_rotation, matrix_from_zxz
from adapter.model.tree import Tree

BODY = theta_from_body(2.0, [0.05, -0.02, 0.1], np.diag([0.02, 0.03, 0.025]))
FLAT = theta_from_body(1.5, [0.0, 0.03, 0.0], np.diag([0.02, 0.01, 0.03 - 2e-8]))
NUMBERS = ("viscous_friction", 1, "Fv"), ("torque_offset", 2, "o")
COUNT, TOLD = 4000, 14
SIZE = np.tile(BODY_SIZE, 2)[:, None]


def known(std: float, *bodies: np.ndarray) -> SelfModel:
    """Two links of which data told TOLD combinations, and two numbers, all of them together.

    Args:
        std: of a combination, as a share of a body of 1 kg, 10 cm across.
    """
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(20, TOLD)) / SIZE)[0]
    ways, theta = np.zeros((22, TOLD + 2)), np.array(bodies or (BODY, FLAT))
    ways[:20, :TOLD] = std * SIZE * np.linalg.qr(basis * SIZE)[0]
    ways[20:] = std * 0.1 * rng.normal(size=(2, TOLD + 2))
    posterior = Posterior(
        NUMBERS,
        np.array([0.0, -np.inf]),
        root_of(ways @ ways.T, TOLD + 2),
        room_of(theta, basis),
        np.array([root_of(x @ x.T, 6) for x in 1e-3 * rng.normal(size=(2, 6, 6))]),
    )
    effects = [
        {"effect": e, "joints": [j], "parameters": {key: 0.4}, "std": {key: 1.0}}
        for e, j, key in NUMBERS
    ]
    tree, lam = Tree((-1, 0), False, ("a", "b"), ("la", "lb"), "base"), rng.normal(size=(2, 6))
    return SelfModel("two", tree, lam, theta, posterior=posterior, effects=tuple(effects))


def rows(models: list[SelfModel]) -> np.ndarray:
    """(count, 22) θ and the two numbers of drawn models."""
    numbers = [[next(iter(e["parameters"].values())) for e in m.effects] for m in models]
    return np.column_stack([np.array([m.theta.ravel() for m in models]), numbers])


def test_a_posterior_reads_back_to_the_last_bit() -> None:
    model = known(0.03)
    back = loads(dumps(model))
    for key in ("effects", "least", "root", "room", "lam_root"):
        a, b = getattr(model.posterior, key), getattr(back.posterior, key)
        assert np.array_equal(np.asarray(a), np.asarray(b)), key
    old = dumps(replace(model, posterior=None)).replace(' "posterior": null,\n', "")
    assert "posterior" not in old and loads(old).posterior is None
    with pytest.raises(ModelError, match="'room' in 'posterior' must hold"):
        loads(dumps(model).replace('"room"', '"rom"'))


def test_draws_are_as_wide_as_said_together() -> None:
    """Where every body of the Gaussian can exist it is the Gaussian, correlations included."""
    model = known(0.003, BODY, BODY)
    assert model.posterior is not None
    root, models = model.posterior.root, model.sample(COUNT, seed=5)
    drawn, asked = rows(models), root @ root.T
    unit = np.sqrt(np.outer(np.diagonal(asked), np.diagonal(asked)))
    assert np.allclose(np.cov(drawn.T) / unit, asked / unit, atol=0.08)
    before = matrix_from_zxz(model.lam[1, :3])
    turned = log_rotation(matrix_from_zxz([m.lam[1, :3] for m in models]) @ before.T)
    root = model.posterior.lam_root[1][:3]
    assert np.allclose(np.cov(turned.T), root @ root.T, atol=3e-7)


@pytest.mark.parametrize("std", [0.02, 0.3])
def test_every_drawn_body_can_exist(std: float) -> None:
    """By an oracle of its own: positive mass, and moments about the centre that a body can have."""
    drawn = known(std).sample(500, seed=2)
    mass, _, tensor = body_from_theta(np.array([m.theta for m in drawn]))
    moments = np.linalg.eigvalsh(tensor)
    assert (mass > 0.0).all() and (moments[..., 0] > 0.0).all()
    assert (moments[..., 0] + moments[..., 1] > moments[..., 2]).all()
    assert (rows(drawn)[:, 20] >= 0.0).all() and (rows(drawn)[:, 21] < 0.4).any()
    assert np.array_equal(rows(known(std).sample(500, seed=2)), rows(drawn))


def test_what_data_told_is_kept_where_a_body_has_to_give_way() -> None:
    """Half the draws would have the flat body thinner than nothing; combinations that data told
    are still as wide as the posterior has them, what no data told moves."""
    model = known(0.02)
    assert model.posterior is not None
    root = model.posterior.root[:20]
    told = np.linalg.qr(np.linalg.svd(root)[0][:, :TOLD] / SIZE**2)[0]  # what torques see
    drawn = rows(model.sample(COUNT, seed=3))[:, :20] - model.theta.ravel()
    asked = np.linalg.norm(told.T @ root, axis=1)
    assert np.allclose((drawn @ told).std(axis=0) / asked, 1.0, atol=0.1)
    hidden = drawn - drawn @ told @ np.linalg.pinv(told)
    assert (np.abs(hidden).max(axis=1) > 1e-6).mean() > 0.3


def test_without_a_posterior_each_number_has_its_own_deviation() -> None:
    std = np.full((2, 10), np.nan)
    std[0, 0] = 0.1
    table = {"effect": "viscous_friction", "joints": [1, 2], "parameters": {"Fv": [0.4, 0.2]}}
    table["std"] = {"Fv": [1.0, None]}
    drawn = replace(known(0.02), posterior=None, theta_std=std, effects=(table,)).sample(COUNT)
    theta = np.array([m.theta.ravel() for m in drawn])
    assert np.isclose(theta[:, 0].std(), 0.1, rtol=0.1) and not np.ptp(theta[:, 1:], axis=0).any()
    first, second = np.array([m.effects[0]["parameters"]["Fv"] for m in drawn]).T
    assert (first >= 0.0).all() and first.std() > 0.3 and (second == 0.2).all()


def test_what_a_search_refined_later_has_its_own_deviation() -> None:
    """Two entries of one number: the posterior is of the first."""
    model = known(0.003, BODY, BODY)
    later = {**model.effects[1], "parameters": {"o": 0.2}, "std": {"o": 0.05}}
    drawn = replace(model, effects=(*model.effects, later)).sample(COUNT)
    first, second = np.array([[e["parameters"]["o"] for e in m.effects[1:]] for m in drawn]).T
    assert model.posterior is not None
    assert np.isclose(first.std(), np.linalg.norm(model.posterior.root[21]), rtol=0.1)
    assert np.isclose(second.std(), 0.05, rtol=0.1) and abs(np.corrcoef(first, second)[0, 1]) < 0.1
