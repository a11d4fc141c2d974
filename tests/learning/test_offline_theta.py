"""θ learned in batch: Pinocchio's torques back, possible bodies, wrenches, noise, signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from adapter.errors import ModelError
from adapter.experiments.falls import smoothed_data
from adapter.learning.batch.prediction_errors import (
    kinematic_errors,
    predicted_torques,
    relative_errors,
)
from adapter.learning.batch.schema import schema_from_moments
from adapter.learning.batch.theta import branches, learn_theta
from adapter.learning.batch.theta_factors import row_factors, scales, system
from adapter.learning.batch.theta_solvers import consistent_theta, least_squares_theta
from adapter.model.inertia import is_consistent, min_eigenvalue
from adapter.model.tree import Tree
from adapter.physics.identifiability import base_parameters
from adapter.physics.networks import FrameMotion, link_motion, theta_from_log_cholesky
from tests.helpers.robot_models import random_urdf, read_quietly, shared
from tests.helpers.torque_errors import torque_errors
from tests.helpers.tree_motion import in_motion, random_tree_text
from tests.learning.test_offline_schema import samples


def random_bodies(count: int, seed: int) -> np.ndarray:
    """Log-Cholesky vectors (count, 10)."""
    usual = np.array([0.4, *[np.log(0.1)] * 3, *[0.0] * 6])
    spread = np.array([0.4, *[0.3] * 3, *[0.03] * 3, *[0.1] * 3])
    return usual + spread * np.random.default_rng(seed).normal(size=(count, 10))


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize(("links", "seed"), [(5, 11), (8, 12), (12, 13)])
def test_possible_bodies_explain_torques_to_rounding(links: int, seed: int, floating: bool) -> None:
    text = random_urdf(links, seed)
    model, data = samples(text, floating, 300, seed)
    _, control = samples(text, floating, 60, seed + 100)
    lam = schema_from_moments(data).lam
    found = learn_theta(data, lam)
    assert found.rank == base_parameters(model.tree, model.lam, model.gravity).rank
    assert found.min_eigenvalue > 0.0 and is_consistent(found.theta)
    error = torque_errors(control, lam, found.theta)
    assert error.median < 1e-9 and error.p99 < 1e-6
    own = branches(model.tree)
    assert [s.name for s in found.stages][: len(own)] == list(own)
    for stage, joints in zip(found.stages, own.values(), strict=False):
        if floating:
            assert stage.rank == 7 * len(joints) < stage.parameters


def test_least_squares_stays_at_the_prior_where_nothing_shows() -> None:
    text = random_urdf(6, 14)
    model, data = samples(text, True, 200, 14)
    prior = model.theta + np.random.default_rng(0).normal(size=model.theta.shape)
    base = base_parameters(model.tree, model.lam, model.gravity)
    rows = row_factors(data, model.lam)
    r, b = system(rows, scales(rows), tuple(range(7)))
    found = least_squares_theta(r, b, prior)
    assert torque_errors(data, model.lam, found.theta).p99 < 1e-8
    ours, theirs = (base.basis.T @ (x - model.theta).ravel() for x in (found.theta, prior))
    assert np.linalg.norm(ours) < 1e-8 < np.linalg.norm(theirs)
    exact = least_squares_theta(r, b, model.theta)  # a prior that fits is left alone
    np.testing.assert_allclose(exact.theta, model.theta, atol=1e-9)
    none = learn_theta(data, model.lam, possible=False, rounds=0)
    assert torque_errors(data, model.lam, none.theta).p99 < 1e-8


def test_rows_weigh_and_sum_as_the_samples_do() -> None:
    """|Y θ - τ| by the factors is that of the samples, for any θ."""
    model, data = samples(random_urdf(5, 16), True, 90, 16)
    rows = row_factors(data, model.lam)
    theta = theta_from_log_cholesky(random_bodies(6, 1))
    gap = predicted_torques(data, model.lam, theta) - data.tau
    joints = [row.residual(theta) for row in rows if row.kind == "torque"]
    np.testing.assert_allclose(joints, np.sqrt(np.mean(gap[:, 6:] ** 2, axis=0)), rtol=1e-9)
    (force,) = [row for row in rows if row.kind == "force"]
    assert force.residual(theta) == pytest.approx(np.sqrt(np.mean(gap[:, :3] ** 2)))
    std = np.arange(1.0, 1.0 + len(rows))
    r, b = system(rows, std, tuple(range(6)))
    weighted = sum(
        (row.residual(theta) / s) ** 2 * row.count for row, s in zip(rows, std, strict=True)
    )
    assert np.sum((r @ theta.ravel() - b) ** 2) == pytest.approx(weighted)


@pytest.mark.parametrize("possible", [False, True])
def test_rows_are_weighed_by_what_is_left_of_them(possible: bool) -> None:
    """A hundredfold noise on every other joint: the weights say so, and good joints stay good."""
    model, data = samples(random_urdf(5, 26), True, 400, 26)
    noise = np.array([1e-3, 1e-1, 1e-3, 1e-1, 1e-3])
    tau = data.tau.copy()
    tau[:, 6:] += noise * np.random.default_rng(2).normal(size=(400, 5))
    noisy = replace(data, tau=tau)
    found = learn_theta(noisy, model.lam, possible)
    std = np.array([s for name, s in found.std.items() if name.startswith("torque")])
    assert (0.8 * noise < std).all() and (std < 1.2 * noise).all()
    error = predicted_torques(data, model.lam, found.theta) - data.tau
    assert np.sqrt(np.mean(error[:, 6:][:, ::2] ** 2, axis=0)).max() < 1e-3
    by_size = learn_theta(noisy, model.lam, possible, rounds=0)
    worse = predicted_torques(data, model.lam, by_size.theta) - data.tau
    assert np.abs(error[:, 6::2]).mean() < 0.8 * np.abs(worse[:, 6::2]).mean()


@pytest.mark.parametrize("seed", [17, pytest.param(18, marks=pytest.mark.slow)])
def test_no_descent_gets_below_the_conic_solution(seed: int) -> None:
    """Noise puts bodies at the edge; scipy's Gauss-Newton on log-Cholesky vectors, from random
    bodies, ends there too or above."""
    model, data = samples(random_urdf(4, seed), True, 60, seed)
    rng = np.random.default_rng(seed)
    tau = data.tau + 5.0 * rng.normal(size=data.tau.shape)
    rows = row_factors(replace(data, tau=tau), model.lam)
    r, b = system(rows, scales(rows), tuple(range(5)))
    found = consistent_theta(r, b)
    assert min_eigenvalue(found.theta).min() > 0.0
    assert least_squares_theta(r, b, found.theta).cost < 0.999 * found.cost  # the edge matters

    def left(x: np.ndarray) -> np.ndarray:
        return r @ theta_from_log_cholesky(x.reshape(5, 10)).ravel() - b

    starts = (random_bodies(5, seed) for seed in (4, 5))
    best = min(least_squares(left, x.ravel(), max_nfev=200).cost for x in starts)
    assert found.cost < 1.0001 * best and best < 1.05 * found.cost


def test_a_solver_that_stops_early_is_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its bodies are possible all the same."""
    rng = np.random.default_rng(6)
    r, b = rng.normal(size=(30, 10)), rng.normal(size=30)
    assert consistent_theta(r, b).converged
    monkeypatch.setattr("adapter.learning.batch.conic.SOLVED", ())
    found = consistent_theta(r, b)
    assert not found.converged and is_consistent(found.theta)


def test_atlas_from_one_percent_of_samples() -> None:
    text = shared("models/atlas_v5.urdf").read_text()
    _, data = samples(text, True, 300, 19)
    _, control = samples(text, True, 40, 20)
    lam = schema_from_moments(data).lam
    largest = kinematic_errors(control, lam).largest
    assert max(largest.values()) < 1e-6, largest
    found = learn_theta(data, lam)
    error = torque_errors(control, lam, found.theta)
    assert error.median < 1e-6 and error.p99 < 1e-3
    assert found.rank == 220 and found.min_eigenvalue > 0.0 and found.converged
    ranks = {s.name: (s.rank, s.parameters) for s in found.stages}
    assert ranks["right leg"] == ranks["left leg"] == (42, 60)
    assert ranks["upper body"] == (126, 180)
    assert ranks["whole tree"] == (220, 310)


def test_relative_error_is_that_of_the_paper() -> None:
    measured = np.array([[2.0, -1.0, 0.05, 1.0]])
    predicted = np.array([[1.0, -2.0, 0.0, -1.0]])
    np.testing.assert_allclose(relative_errors(measured, predicted), [[0.5, 0.5, np.nan, 2.0]])
    with pytest.raises(ModelError, match="not finite"):
        relative_errors(measured, predicted * np.nan)
    with pytest.raises(ModelError, match="like tables"):
        relative_errors(measured, predicted[:, :2])


def test_errors_summed_up_are_those_of_the_samples() -> None:
    model, data = samples(random_urdf(5, 27), True, 40, 27)
    lam = model.lam + 0.01
    joints = tuple(map(torch.from_numpy, data.joints()))
    k = link_motion(data.tree, torch.from_numpy(lam), joints, FrameMotion.of(data.base.rows()))
    found = kinematic_errors(data, lam)
    for name, by_link in found.largest_by_link.items():
        gap = np.abs(getattr(k, name)[:, 1:].numpy() - getattr(data.links, name))
        np.testing.assert_allclose(by_link, gap.max(axis=(0, 2)), rtol=1e-9)
        assert found.largest[name] == by_link.max()


@pytest.mark.parametrize("seed", [21, pytest.param(22, marks=pytest.mark.slow)])
def test_noisy_signals_cost_no_more_than_with_true_frames(seed: int) -> None:
    """Control torque error of learned λ and θ against weighted least squares with the true λ."""
    text, rng = random_tree_text(5, seed), np.random.default_rng(seed)
    clean, parts = [], []
    for part in range(3):
        model, data = in_motion(text, False, 6.0, 10 * seed + part)
        noise = {"q": 2e-5, "dq": 2e-3, "tau": 0.1, "link_w": 2e-3, "link_a": 0.02}
        true = {key: getattr(data, key) for key in ("q", "dq", "tau")}
        true |= {"link_w": data.links.w, "link_a": data.links.a}
        read = {name: x + noise[name] * rng.normal(size=x.shape) for name, x in true.items()}
        parts.append(smoothed_data(model.tree, read, gravity=model.gravity))
        exact = smoothed_data(model.tree, true, gravity=model.gravity)
        cut = slice(200, -200)
        assert np.abs(exact.ddq - data.ddq[cut]).max() < 2e-2 * np.abs(data.ddq).max()
        assert (exact.base.a == -model.gravity).all()  # what an accelerometer at rest reads
        clean.append(exact)
    learn, control = parts[0].take(slice(None, None, 3)), clean[2]
    schema = schema_from_moments(learn)
    found = learn_theta(learn, schema.lam)
    best = learn_theta(learn, model.lam, possible=False)
    ours = torque_errors(control, schema.lam, found.theta).rmse
    theirs = torque_errors(control, model.lam, best.theta).rmse
    assert np.linalg.norm(ours) <= 1.1 * np.linalg.norm(theirs)
    assert found.min_eigenvalue > 0.0


def test_a_base_at_rest_needs_gravity() -> None:
    _, data = samples(random_urdf(5, 23), True, 30, 23)
    with pytest.raises(ModelError, match="gravity"):
        signals = {"q": data.q, "dq": data.dq, "tau": data.tau[:, 6:]}
        fixed = {name: np.tile(x, (20, 1)) for name, x in signals.items()}
        smoothed_data(replace(data.tree, floating=False), fixed)


@pytest.mark.parametrize(("robot", "joints"), [("atlas", 30), ("talos", 32)])
def test_branches_of_humanoids(robot: str, joints: int) -> None:
    path = {"atlas": "models/atlas_v5.urdf", "talos": "models/talos_reduced.urdf"}[robot]
    tree = read_quietly(shared(path).read_text(), True).tree
    found = branches(tree)
    assert set(found) == {"right leg", "left leg", "upper body"}
    assert len(found["right leg"]) == len(found["left leg"]) == 6
    assert len(found["upper body"]) == joints - 12
    assert sorted(j for joints in found.values() for j in joints) == list(range(joints))
    for side in ("right", "left"):
        names = " ".join(tree.joint_names[j] for j in found[f"{side} leg"])
        assert "leg" in names and (f"{side}_" in names or f"{side[0]}_leg" in names)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_branches_of_any_tree(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parent = tuple(int(rng.integers(-1, j)) if j % 5 else -1 for j in range(17))
    found = branches(Tree(parent, bool(seed % 2)))
    assert list(found) == [f"branch {k + 1}" for k in range(parent.count(-1))]
    assert sorted(j for joints in found.values() for j in joints) == list(range(17))
    for joints in found.values():
        assert [parent[j] in joints for j in joints] == [False, *[True] * (len(joints) - 1)]
