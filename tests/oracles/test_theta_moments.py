"""θ from second moments: log-Cholesky kernels, weighted cost and its gradient, normal equations."""

import numpy as np
import pytest
import torch
from arm_data import Motion, arm, panda_model, record, states_of

from adapter.dynamics import regressor, theta_from_log_cholesky_torch
from adapter.effects import effects_by_name
from adapter.inertia import (
    min_eigenvalue,
    pseudo_inertia,
    theta_from_log_cholesky,
)
from adapter.records import StateLayout
from adapter.spatial import matrix_from_zxz
from adapter.theta_kernels import body_from_log_cholesky, forget_along, gradient, pull_back
from adapter.theta_learner import ThetaLearner
from adapter.theta_settings import ThetaSettings
from adapter.twist import base_motion

SEEDS = range(5)
EFFECTS = ("viscous_friction", "coulomb_friction", "torque_offset")
N = 7


def kernel_body(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    U, th = np.full((4, 4), np.nan), np.full(10, np.nan)
    body_from_log_cholesky(x, U, th)
    return U, th


@pytest.mark.parametrize("seed", SEEDS)
def test_log_cholesky_kernel_is_that_of_inertia(seed: int) -> None:
    x = np.random.default_rng(seed).normal(size=10)
    U, th = kernel_body(x)
    assert np.allclose(th, theta_from_log_cholesky(x), rtol=1e-13, atol=1e-14)
    assert np.allclose(U @ U.T, pseudo_inertia(th), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("seed", SEEDS)
def test_pull_back_is_the_transposed_jacobian(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, g = rng.normal(size=(2, 10))
    U, _ = kernel_body(x)
    found = np.full(10, np.nan)
    pull_back(U, g, found)
    t = torch.from_numpy(x)
    jacobian = torch.autograd.functional.jacobian(theta_from_log_cholesky_torch, t).numpy()
    assert np.allclose(found, jacobian.T @ g, rtol=1e-11, atol=1e-12)
    step = 1e-6
    slopes = [
        g @ (kernel_body(x + e)[1] - kernel_body(x - e)[1]) / (2 * step) for e in step * np.eye(10)
    ]
    assert np.allclose(found, slopes, rtol=1e-6, atol=1e-6 * np.abs(found).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_random_vectors_are_possible_bodies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = np.array([kernel_body(x)[1] for x in rng.normal(size=(200, 10))])
    assert (min_eigenvalue(bodies) > 0.0).all()


def make_learner(effects=EFFECTS, **settings) -> ThetaLearner:
    model = panda_model()
    chosen = effects_by_name(effects)
    base = base_motion(model.gravity)
    return ThetaLearner(model.tree, base, chosen, ThetaSettings(**settings), noise_gain=20.0)


def frames() -> tuple[np.ndarray, np.ndarray]:
    lam = panda_model().lam
    return np.ascontiguousarray(matrix_from_zxz(lam[:, :3])), np.ascontiguousarray(lam[:, 3:])


def tables(seed: int, rows: int = 400):
    """q, dq, ddq, tau of filtered states of a moving arm, thinned out."""
    table = states_of(record(arm(), Motion(5.0, seed)))
    at = StateLayout(N)
    some = table[:: len(table) // rows][:rows]
    return [np.ascontiguousarray(some[:, part]) for part in (at.q, at.dq, at.ddq, at.tau)]


def full_rows(learner: ThetaLearner, q, dq, ddq) -> np.ndarray:
    """Rows (m, n, P) of the whole model by the torch network; the spare body's are zero."""
    model = panda_model()
    signals = [torch.from_numpy(x) for x in (model.lam, q, dq, ddq, model.gravity)]
    out = np.zeros((len(q), N, learner.P))
    out[:, :, : 10 * N] = regressor(model.tree, *signals).numpy()
    joint = np.arange(N)
    for k, effect in enumerate(learner.effects):
        out[:, joint, 10 * learner.bodies + k * N + joint] = effect.column(q, dq, ddq)
    return out


@pytest.mark.parametrize("seed", range(3))
def test_moments_are_the_batch_normal_equations(seed: int) -> None:
    learner = make_learner()
    signals = tables(seed)
    for part in np.array_split(np.arange(len(signals[0])), 7):
        learner.absorb(*frames(), *(x[part] for x in signals))
    Y, tau = full_rows(learner, *signals[:3]), signals[3]
    assert learner.count == len(tau)
    H, rhs = learner.information()
    weight = 1.0 / (learner.noise_gain * learner.variance())
    expected = learner.prior + np.einsum("mja,j,mjb->ab", Y, weight, Y)
    expected_rhs = learner.prior_rhs + np.einsum("mja,j,mj->a", Y, weight, tau)
    assert np.allclose(H, expected, rtol=1e-10, atol=1e-9 * np.abs(expected).max())
    assert np.allclose(rhs, expected_rhs, rtol=1e-10, atol=1e-9 * np.abs(expected_rhs).max())


@pytest.mark.parametrize("seed", range(3))
def test_errors_are_measured_minus_predicted(seed: int) -> None:
    learner = make_learner()
    signals = tables(seed, rows=50)
    expected = signals[3] - full_rows(learner, *signals[:3]) @ learner.th
    first = learner.errors(*frames(), *signals)
    assert np.allclose(first, expected, atol=1e-9)
    assert learner.count == 0 and (learner.A == 0.0).all()
    assert np.array_equal(learner.absorb(*frames(), *signals), first)


@pytest.mark.parametrize("seed", range(3))
def test_variance_is_the_residuals_own(seed: int) -> None:
    learner = make_learner()
    signals = tables(seed)
    learner.absorb(*frames(), *signals)
    cost = (learner.errors(*frames(), *signals) ** 2).sum(axis=0)
    floor = learner.model_variance
    expected = (cost + floor) / (len(signals[0]) + 1.0) + floor
    assert np.allclose(learner.variance(), expected, rtol=1e-7)


def values_of(x: torch.Tensor, bodies: int) -> torch.Tensor:
    """θ and effects (P,) of the flat parameters, by torch."""
    k = 10 * bodies
    return torch.cat([theta_from_log_cholesky_torch(x[:k].reshape(-1, 10)).ravel(), x[k:]])


@pytest.mark.parametrize("seed", range(3))
def test_gradient_of_the_data_is_autograds(seed: int) -> None:
    learner = make_learner()
    signals = tables(seed)
    learner.x += 0.2 * np.random.default_rng(seed).normal(size=learner.P)
    learner.mean[:] = learner.x
    learner.after_step(settled=False)  # the values in use, and with them the variance, follow x
    learner.absorb(*frames(), *signals)
    assert learner.compute_gradient()
    ours = learner.gradient.copy()
    weight = torch.from_numpy(1 / (learner.noise_gain * learner.variance()))
    learner.A[:] = 0.0
    assert learner.compute_gradient()
    ours -= learner.gradient  # priors, whatever they are, cancel
    x = torch.tensor(learner.x, requires_grad=True)
    Y = torch.from_numpy(full_rows(learner, *signals[:3]))
    error = torch.from_numpy(signals[3]) - Y @ values_of(x, learner.bodies)
    (0.5 * (weight * error**2).sum() / len(error)).backward()
    assert np.abs(ours - x.grad.numpy()).max() < 1e-8 * np.abs(x.grad.numpy()).max()
    assert np.abs(ours[10 * N : 10 * N + 10]).max() == 0.0  # the idle spare body


@pytest.mark.parametrize("seed", range(3))
def test_gradient_of_the_prior_is_autograds(seed: int) -> None:
    learner = make_learner(warm_up=1)
    learner.x += 0.2 * np.random.default_rng(seed).normal(size=learner.P)
    learner.count = 10.0
    assert learner.compute_gradient()
    x = torch.tensor(learner.x, requires_grad=True)
    th = values_of(x, learner.bodies)
    prior, rhs = (torch.from_numpy(v) for v in (learner.prior, learner.prior_rhs))
    ((0.5 * th @ prior @ th - rhs @ th) / 10.0).backward()
    expected = x.grad.numpy()
    radii = np.zeros(learner.P, dtype=bool)  # d1 d2 d3 carry a prior of their own beside it
    radii[: 10 * learner.bodies].reshape(-1, 10)[:, 1:4] = True
    error = np.abs(learner.gradient - expected)[~radii]
    assert error.max() < 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize("seed", range(3))
def test_gradient_is_the_slope_of_the_profiled_cost(seed: int) -> None:
    """Weighted by its own variance, a joint's cost is half the log of that variance."""
    rng = np.random.default_rng(seed)
    n, m = 2, 60
    rows, tau = rng.normal(size=(m, n, 10)), rng.normal(size=(m, n))
    z = np.concatenate([rows, tau[:, :, None]], axis=2)
    A = np.einsum("mja,mjb->jab", z, z)
    place, sizes = np.tile(np.arange(10), (n, 1)), np.full((n, 2), 10)
    x = rng.normal(size=10) * 0.3
    nothing, no_rhs, floor = np.zeros((10, 10)), np.zeros(10), np.zeros(n)
    found = []
    for radius_weight in (0.0, 1.0):
        gx = np.zeros(10)
        work = np.zeros(10), np.zeros(10)
        settings = (float(m), 1.0, floor, 0.0, 0.0)
        gradient(x, 1, A, sizes, place, *settings, nothing, no_rhs, radius_weight, *work, gx)
        found.append(gx)

    def profiled(v: np.ndarray) -> float:
        error = tau - rows @ kernel_body(v)[1]
        return float(0.5 * np.log((error**2).mean(axis=0)).sum())

    step = 1e-6
    slopes = [(profiled(x + e) - profiled(x - e)) / (2 * step) for e in step * np.eye(10)]
    assert np.allclose(found[0], slopes, rtol=1e-5, atol=1e-7)
    pull = np.zeros(10)  # log-normal prior on the radii exp(d): 0.1 m, standard deviation 2
    pull[1:4] = (x[1:4] - np.log(0.1)) / 4.0 / m
    assert np.allclose(found[1] - found[0], pull, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("effects", [(), EFFECTS])
def test_least_squares_is_numpys(seed: int, effects: tuple[str, ...]) -> None:
    learner = make_learner(effects)
    signals = tables(seed)
    learner.absorb(*frames(), *signals)
    found = learner.least_squares()
    Y = full_rows(learner, *signals[:3])
    root = 1.0 / np.sqrt(learner.noise_gain * learner.variance())
    std = np.sqrt(1.0 / np.diag(learner.prior)[learner.known()])
    mean = (learner.prior_rhs * np.where(np.diag(learner.prior) > 0, 1, 0))[learner.known()]
    at = learner.known()
    A = np.vstack([(root[:, None] * Y).reshape(-1, learner.P)[:, at], np.diag(1.0 / std)])
    b = np.concatenate([(root * signals[3]).ravel(), mean * std])
    expected = np.linalg.lstsq(A, b, rcond=None)[0]
    assert np.abs(found[at] - expected).max() < 1e-6 * np.abs(expected).max()
    tau = Y[:, :, at] @ found[at]
    assert np.abs(tau - Y[:, :, at] @ expected).max() < 1e-8 * np.abs(tau).max()


@pytest.mark.parametrize("seed", SEEDS)
def test_forgetting_takes_only_what_the_row_knows(seed: int) -> None:
    """A stays positive, loses rate z' A z along z, and nothing of what is conjugate to z."""
    rng = np.random.default_rng(seed)
    s, rate = 6, 0.05
    past = rng.normal(size=(40, s + 1))
    A = (past.T @ past)[None]
    before = A[0].copy()
    rows, tau = rng.normal(size=(1, s)), rng.normal(size=1)
    z = np.append(rows[0], tau)
    forget_along(rows, tau, np.array([[s, s]]), rate, A)
    assert z @ A[0] @ z == pytest.approx((1 - rate) * (z @ before @ z))
    other = rng.normal(size=s + 1)
    other -= z * (other @ before @ z) / (z @ before @ z)
    assert other @ A[0] @ other == pytest.approx(other @ before @ other)
    assert np.linalg.eigvalsh(A[0])[0] > 0.0


def test_a_known_tool_is_taken_off_first() -> None:
    model = panda_model()
    tool = theta_from_log_cholesky(np.array([-0.5, -2, -2, -2, 0, 0, 0, 0.1, 0, 0.2]))
    with_tool = ThetaLearner(model.tree, base_motion(model.gravity), tool_theta=tool)
    without = ThetaLearner(model.tree, base_motion(model.gravity))
    q, dq, ddq, tau = tables(0, rows=100)
    load = full_rows(without, q, dq, ddq)[:, :, 10 * N - 10 : 10 * N] @ tool
    with_tool.absorb(*frames(), q, dq, ddq, tau + load)
    without.absorb(*frames(), q, dq, ddq, tau)
    assert np.allclose(with_tool.A, without.A, rtol=1e-9, atol=1e-7)
