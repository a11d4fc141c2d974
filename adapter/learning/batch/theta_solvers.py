"""Solvers of R θ = b: least squares in base parameters, and over bodies that can exist.

A body can exist where its pseudo-inertia (4, 4), linear in θ, is positive definite (Wensing, Kim
and Slotine 2018). Least squares over such bodies is a semidefinite program (Clarabel solves it):
convex, so there is one answer and no start to choose. Where the data can be explained to the last
bit, one of the explanations is a robot: it is looked for among the explanations alone, as the one
furthest from impossible, so that no digit is lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from adapter.errors import ModelError
from adapter.learning.batch.conic import LENGTH, NONNEGATIVE, POSSIBLE, entries, solve_conic
from adapter.model.inertia import min_eigenvalue, pseudo_inertia
from adapter.model.spatial import Array
from adapter.physics.identifiability import RANK_TOLERANCE

EDGE = 1e-6  # kg, least eigenvalue in those units of a body that noise pushes to the edge
HELD = 1e-9  # weight of a body of 1 kg and radius `LENGTH`, to the mean weight of the data


@dataclass(frozen=True)
class Solution:
    """What a solver found.

    Attributes:
        theta: (bodies, 10).
        cost: half the weighted sum of squares that is left.
        steps: taken.
        rank: directions of θ that the rows show.
        converged: whether the cost is the least that such bodies allow.
    """

    theta: Array
    cost: float
    steps: int
    rank: int
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
    """Least squares over possible bodies.

    Raises:
        ModelError: the solver gave up without an answer.
    """
    scale, u, values, vt = _decomposed(r)
    shown = (vt[: len(values)].T @ ((u.T @ b) / values)) / scale
    hidden = vt[len(values) :].T / np.where(np.isfinite(scale), scale, 1.0)[:, None]
    theta, steps, solved = _roomiest(shown.reshape(-1, 10), hidden)
    if not solved:  # least is left by possible bodies, what does not show near a small one
        theta, more, solved = _closest(r, b)
        steps += more
    return Solution(theta, _cost(r, b, theta), steps, len(values), solved)


def _decomposed(r: Array) -> tuple[Array, Array, Array, Array]:
    """Column scale s (inf for a column of zeros) and the singular values of R / s that count.

    Returns:
        s (10 bodies,), U (k, rank), values (rank,), Vᵀ (10 bodies, 10 bodies): rows beyond the
        rank are directions of θ s that R does not show.
    """
    scale = np.linalg.norm(r, axis=0)
    scale = np.where(scale > RANK_TOLERANCE * scale.max(initial=1e-300), scale, np.inf)
    try:
        u, values, vt = np.linalg.svd(r / scale, full_matrices=True)
    except np.linalg.LinAlgError:  # the slower algorithm
        u, values, vt = scipy.linalg.svd(r / scale, full_matrices=True, lapack_driver="gesvd")
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[0]))
    return scale, u[:, :rank], values[:rank], vt


_UNITS = np.diag([1.0 / LENGTH] * 3 + [1.0])
_FROM_THETA = entries(_UNITS @ pseudo_inertia(np.eye(10)) @ _UNITS).T  # entries of one body
_TO_THETA = np.linalg.inv(_FROM_THETA)
_ONE = entries(np.eye(4))  # a body of 1 kg whose radius about its origin is `LENGTH` each way


def _roomiest(shown: Array, hidden: Array) -> tuple[Array, int, bool]:
    """Among all least-squares solutions the one whose bodies are furthest from impossible.

    θ, steps, and whether all its bodies are possible.

    `hidden` (10 bodies, h) are directions of θ that R does not show.

    Maximised is the least eigenvalue t of all bodies, up to `ROOM`; solved if it is above zero.
    """
    bodies, count = len(shown), hidden.shape[1]
    fixed = (shown @ _FROM_THETA.T).ravel()
    moved = np.einsum("ek,bkh->beh", _FROM_THETA, hidden.reshape(bodies, 10, count))
    free = np.linalg.qr(moved.reshape(10 * bodies, count))[0]
    one = np.tile(_ONE, bodies)
    size = max(float(np.abs(fixed).max()), 1e-300)
    goal = np.append(1e-6 * (free.T @ one), -1.0)  # what is unseen stays light
    in_cone = np.column_stack([-free, one])
    in_room = np.append(np.zeros(count), 1.0)
    in_cones = [*[POSSIBLE] * bodies, NONNEGATIVE]
    x, steps, _ = solve_conic(
        np.zeros((count + 1, count + 1)),
        goal,
        np.vstack([in_cone, in_room]),
        np.append(fixed, 1e-2) / size,  # kg: more room is worth nothing
        in_cones,
    )
    if not np.isfinite(x).all():
        return shown, steps, False
    theta = (fixed + size * (free @ x[:count])).reshape(bodies, 10) @ _TO_THETA.T
    return theta, steps, bool(min_eigenvalue(theta).min() > 0.0)


def _closest(r: Array, b: Array) -> tuple[Array, int, bool]:
    """Least squares with every eigenvalue at least `EDGE`: θ, steps, and whether it is the best."""
    bodies = r.shape[1] // 10
    table = np.einsum("kbe,ef->kbf", r.reshape(len(r), bodies, 10), _TO_THETA)
    table = table.reshape(len(r), -1)
    power = float(b @ b) or 1.0
    quadratic, goal = table.T @ table / power, -(table.T @ b) / power
    hold = HELD * float(np.trace(quadratic)) / len(quadratic)
    eye, one = np.eye(len(quadratic)), np.tile(_ONE, bodies)
    edges = -eye, -EDGE * one, [POSSIBLE] * bodies
    x, steps, solved = solve_conic(quadratic + hold * eye, goal - hold * one, *edges)
    if not np.isfinite(x).all():
        raise ModelError("no possible bodies were found near what the data say; are they sound?")
    theta = x.reshape(bodies, 10) @ _TO_THETA.T
    least = np.linalg.eigvalsh(_UNITS @ pseudo_inertia(theta) @ _UNITS).min(axis=-1)
    # where the solver stopped short of the edge's right side
    lifted = np.maximum(EDGE - least, 0.0)[:, None] * (_ONE @ _TO_THETA.T)
    return theta + lifted, steps, solved


def _cost(r: Array, b: Array, theta: Array) -> float:
    left = r @ theta.ravel() - b
    return 0.5 * float(left @ left)
