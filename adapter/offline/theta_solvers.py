"""Solvers of R θ = b: least squares in base parameters, and two over bodies that can exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch

from adapter.dynamics import theta_from_log_cholesky_torch
from adapter.identifiability import RANK_TOLERANCE
from adapter.inertia import theta_from_log_cholesky
from adapter.offline.possible_bodies import possible_theta
from adapter.spatial import Array

# Random bodies to start from: masses (kg), distance of the centre and radii of gyration (m).
START_MASS, START_REACH, START_RADIUS, START_SPREAD = (0.5, 10.0), 0.1, 0.1, 0.3
GAP, NEGLIGIBLE = 1e-7, 1e-14


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    Attributes:
        theta: (bodies, 10).
        cost: half the weighted sum of squares that is left.
        steps: taken.
        rank: directions of θ that the rows show; None where the solver does not ask.
        converged: whether the cost is the least that such bodies allow, but for `GAP` of it or
            `NEGLIGIBLE` of the signal.
    """

    theta: Array
    cost: float
    steps: int
    rank: int | None = None
    converged: bool = True


def least_squares_theta(r: Array, b: Array, prior: Array) -> Solution:
    """The θ of least squares that is nearest to the prior in what the rows don't show.

    Args:
        r: (k, 10 bodies); b: (k,) from `theta_factors.system`.
        prior: (bodies, 10).
    """
    scale, u, values, vt = _decomposed(r)
    left = b - r @ prior.ravel()
    change = (vt[: len(values)].T @ ((u.T @ left) / values)) / scale
    theta = prior + change.reshape(prior.shape)
    return Solution(theta, _cost(r, b, theta), 1, len(values))


def consistent_theta(r: Array, b: Array) -> Solution:
    """Least squares over possible bodies, see `possible_bodies`.

    Raises:
        ModelError: the solver gave up without an answer.
    """
    scale, u, values, vt = _decomposed(r)
    shown = (vt[: len(values)].T @ ((u.T @ b) / values)) / scale
    hidden = vt[len(values) :].T / np.where(np.isfinite(scale), scale, 1.0)[:, None]
    found = possible_theta(r, b, shown, hidden)
    cost = _cost(r, b, found.theta)
    return Solution(found.theta, cost, found.steps, len(values), found.solved)


def _decomposed(r: Array) -> tuple[Array, Array, Array, Array]:
    """Column scale s (inf for a column of zeros) and the singular values of R / s that count.

    Returns:
        s (10 bodies,), U (k, rank), values (rank,), Vᵀ (10 bodies, 10 bodies): rows beyond the
        rank are directions of θ s that R does not show.
    """
    scale = np.linalg.norm(r, axis=0)
    scale = np.where(scale > RANK_TOLERANCE * scale.max(initial=1e-300), scale, np.inf)
    u, values, vt = _svd(r / scale)
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[0]))
    return scale, u[:, :rank], values[:rank], vt


def _svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Full SVD; by the slower algorithm where the fast one does not converge."""
    try:
        u, values, vt = np.linalg.svd(matrix, full_matrices=True)
    except np.linalg.LinAlgError:
        u, values, vt = scipy.linalg.svd(matrix, full_matrices=True, lapack_driver="gesvd")
    return u, values, vt


def adam_theta(
    r: Array,
    b: Array,
    start: Array,
    steps: int = 5000,
    rate: float = 1e-2,
    last_rate: float = 1e-4,
    betas: tuple[float, float] = (0.97, 0.99),
) -> Solution:
    """ADAM on the moments R^T R over possible bodies, as the online learner descends them.

    Any log-Cholesky vector is a possible body, so no constraint is needed.

    Args:
        start: (bodies, 10) log-Cholesky vectors.
    """
    x = torch.from_numpy(start.copy()).requires_grad_()
    power = float(b @ b) or 1.0
    factor, right = (torch.from_numpy(np.ascontiguousarray(a / np.sqrt(power))) for a in (r, b))
    moments, cross = factor.T @ factor, factor.T @ right
    optimiser = torch.optim.Adam([x], lr=rate, betas=betas, eps=1e-14)
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * (last_rate / rate) ** (step / steps)
        optimiser.zero_grad()
        theta = theta_from_log_cholesky_torch(x).ravel()
        (0.5 * theta @ (moments @ theta) - cross @ theta).backward()
        optimiser.step()
    found = theta_from_log_cholesky(x.detach().numpy())
    cost, least = _cost(r, b, found), consistent_theta(r, b).cost
    close = cost - least <= max(GAP * least, NEGLIGIBLE * 0.5 * power)
    return Solution(found, cost, steps, converged=close)


def random_bodies(count: int, rng: np.random.Generator) -> Array:
    """Log-Cholesky vectors (count, 10) of random possible bodies."""
    mass = np.exp(rng.uniform(np.log(START_MASS[0]), np.log(START_MASS[1]), count))
    radii = np.log(START_RADIUS) + START_SPREAD * rng.normal(size=(count, 3))
    sides = START_RADIUS * START_SPREAD * rng.normal(size=(count, 3))
    centre = START_REACH * rng.normal(size=(count, 3))
    return np.concatenate([0.5 * np.log(mass)[:, None], radii, sides, centre], axis=1)


def _cost(r: Array, b: Array, theta: Array) -> float:
    left = r @ theta.ravel() - b
    return 0.5 * float(left @ left)
