"""Solvers of R θ = b: least squares in base parameters, and two over bodies that can exist.

Any log-Cholesky vector is a possible body, so the last two need no constraints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from scipy.optimize import least_squares

from adapter.dynamics import theta_from_log_cholesky_torch
from adapter.identifiability import RANK_TOLERANCE
from adapter.inertia import is_consistent, log_cholesky_from_theta, theta_from_log_cholesky
from adapter.offline.interior_point import GAP, NEGLIGIBLE, interior_point
from adapter.offline.theta_factors import PER_BODY
from adapter.spatial import Array

# Random bodies to start from: masses (kg), distance of the centre and radii of gyration (m).
START_MASS, START_REACH, START_RADIUS, START_SPREAD = (0.5, 10.0), 0.1, 0.1, 0.3
TOLERANCE = 1e-15  # of Gauss-Newton, relative: rounding


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    Attributes:
        theta: (bodies, 10).
        cost: half the weighted sum of squares that is left.
        steps: taken.
        rank: directions of θ that the rows show; None where the solver does not ask.
        converged: whether the cost is known to be the least that such bodies allow, but for what
            is negligible (`NEGLIGIBLE` of the signal, `GAP` of the cost).
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
    scale = np.linalg.norm(r, axis=0)
    scale = np.where(scale > RANK_TOLERANCE * scale.max(initial=1e-300), scale, np.inf)
    u, values, vt = _svd(r / scale)
    shown = values > RANK_TOLERANCE * values[0]
    left = b - r @ prior.ravel()
    change = (vt[shown].T @ ((u[:, shown].T @ left) / values[shown])) / scale
    theta = prior + change.reshape(prior.shape)
    return Solution(theta, _cost(r, b, theta), 1, int(np.count_nonzero(shown)))


def _svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Thin SVD; by the slower algorithm where the fast one does not converge."""
    try:
        u, values, vt = np.linalg.svd(matrix, full_matrices=False)
    except np.linalg.LinAlgError:
        u, values, vt = scipy.linalg.svd(matrix, full_matrices=False, lapack_driver="gesvd")
    return u, values, vt


def consistent_theta(r: Array, b: Array, start: Array, steps: int = 60) -> Solution:
    """Least squares over possible bodies: an interior point's path, then scipy's Gauss-Newton.

    The path is convex and finds its way from any start; where the data leave next to nothing
    unexplained, a trust-region Gauss-Newton on log-Cholesky vectors (Jacobian by the chain rule)
    takes the barrier's last trace away. What is found is held against the cost of least squares
    without constraint; where it can't be told from too much, the path is tried once more from
    the reference bodies. All bodies returned are possible.

    Args:
        r, b: as above.
        start: (bodies, 10) log-Cholesky vectors.
        steps: of Gauss-Newton at most.
    """
    found = _on_path(r, b, theta_from_log_cholesky(start), steps)
    if found.converged:
        return found
    again = _on_path(r, b, None, steps)
    best = again if again.converged or again.cost < found.cost else found
    return replace(best, steps=found.steps + again.steps)


def _on_path(r: Array, b: Array, start: Array | None, steps: int) -> Solution:
    """An interior point's path from a start, and the polish where it is worth its while."""
    reached = interior_point(r, b, start)
    cost = _cost(r, b, reached.theta)
    if reached.close:
        return Solution(reached.theta, cost, reached.steps)
    theta, evaluations = _polished(r, b, reached.theta, steps)
    if not is_consistent(theta) or _cost(r, b, theta) > cost:
        theta = reached.theta
    return _judged(r, b, theta, reached.steps + evaluations, reached.gap)


def _judged(r: Array, b: Array, theta: Array, steps: int, gap: float) -> Solution:
    """Whether the cost of possible bodies, at most `gap` too much, is known to be the least."""
    cost, free = _cost(r, b, theta), least_squares_theta(r, b, theta)
    allowed = max(GAP * cost, NEGLIGIBLE * 0.5 * float(b @ b))
    return Solution(theta, cost, steps, free.rank, min(cost - free.cost, gap) <= allowed)


def _polished(r: Array, b: Array, theta: Array, steps: int) -> tuple[Array, int]:
    """Trust-region Gauss-Newton on log-Cholesky vectors from possible bodies: bodies, steps."""
    bodies, best, steps_done = len(theta), theta, 0
    blocks = r.reshape(len(r), bodies, PER_BODY)

    def residual(x: Array) -> Array:
        return np.asarray(r @ theta_from_log_cholesky(x.reshape(bodies, PER_BODY)).ravel() - b)

    def jacobian(x: Array) -> Array:  # asked for at the start and at every step that went down
        nonlocal best, steps_done
        best, steps_done = theta_from_log_cholesky(x.reshape(bodies, PER_BODY)), steps_done + 1
        inner = _log_cholesky_jacobian(x.reshape(bodies, PER_BODY))
        return np.asarray(np.einsum("kbi,bij->kbj", blocks, inner).reshape(len(r), -1))

    try:
        found = least_squares(
            residual,
            log_cholesky_from_theta(theta).ravel(),
            jacobian,
            method="trf",
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            gtol=TOLERANCE,
            max_nfev=steps,
        )
    except np.linalg.LinAlgError:  # LAPACK's fast SVD gives up on one matrix in thousands
        return best, steps_done
    return theta_from_log_cholesky(found.x.reshape(bodies, PER_BODY)), int(found.nfev)


def adam_theta(
    r: Array,
    b: Array,
    start: Array,
    steps: int = 5000,
    rate: float = 1e-2,
    last_rate: float = 1e-4,
    betas: tuple[float, float] = (0.97, 0.99),
) -> Solution:
    """ADAM on the moments R^T R over possible bodies, as the online learner descends them."""
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
    return _judged(r, b, found, steps, np.inf)


def random_bodies(count: int, rng: np.random.Generator) -> Array:
    """Log-Cholesky vectors (count, 10) of random possible bodies."""
    mass = np.exp(rng.uniform(np.log(START_MASS[0]), np.log(START_MASS[1]), count))
    radii = np.log(START_RADIUS) + START_SPREAD * rng.normal(size=(count, 3))
    sides = START_RADIUS * START_SPREAD * rng.normal(size=(count, 3))
    centre = START_REACH * rng.normal(size=(count, 3))
    return np.concatenate([0.5 * np.log(mass)[:, None], radii, sides, centre], axis=1)


def _log_cholesky_jacobian(x: Array) -> Array:
    """d theta / d x (bodies, 10, 10)."""
    every = torch.func.vmap(torch.func.jacrev(theta_from_log_cholesky_torch))
    return np.asarray(every(torch.from_numpy(np.ascontiguousarray(x))).numpy())


def _cost(r: Array, b: Array, theta: Array) -> float:
    left = r @ theta.ravel() - b
    return 0.5 * float(left @ left)
