"""θ of a discovered tree from the joints' torques alone: eq. 19 over bodies that can exist."""

from __future__ import annotations

import numpy as np

from adapter.inertia import theta_from_body
from adapter.offline.theta_factors import row_factors, scales, system
from adapter.offline.theta_solvers import consistent_theta, least_squares_theta
from adapter.spatial import Array
from adapter.theta_settings import NEUTRAL_INERTIA, NEUTRAL_MASS, PRIOR_STD
from adapter.tree_data import TreeData

ROUNDS = 3  # of weighting
LEAST_TORQUE = 1e-4  # N m; no joint is trusted to be explained better


def neutral_theta(bodies: int) -> Array:
    """θ (bodies, 10) of what is believed of a link before any data."""
    body = theta_from_body(NEUTRAL_MASS, np.zeros(3), NEUTRAL_INERTIA * np.eye(3))
    return np.tile(body, (bodies, 1))


def theta_of(data: TreeData, lam: Array) -> tuple[Array, Array]:
    """θ (bodies, 10) and the torque (n,), N m rms, that it leaves unexplained.

    The wrench on a floating base is not used: nothing in a recording measures it. What torques
    don't show stays near a neutral body. Friction is not modelled.

    Args:
        data: samples with joint torques; the base's motion with gravity.
        lam: (n, 6) λ.
    """
    rows = [row for row in row_factors(data, lam) if row.kind == "torque"]
    first = data.tree.bodies - data.tree.n
    bodies = tuple(range(first, data.tree.bodies))
    theta = neutral_theta(data.tree.bodies)
    std = scales(rows)
    for _ in range(ROUNDS):  # weighted by what the round before left
        r, b = system(rows, std, bodies)
        theta[first:] = least_squares_theta(r, b, theta[first:]).theta
        std = np.array([max(row.residual(theta), LEAST_TORQUE) for row in rows])
    r, b = _with_prior(*system(rows, std, bodies), neutral_theta(len(bodies)))
    theta[first:] = consistent_theta(r, b).theta
    return theta, np.array([row.residual(theta) for row in rows])


def _with_prior(r: Array, b: Array, centre: Array) -> tuple[Array, Array]:
    """Rows below that hold θ (bodies, 10) to a centre, by how far links differ from one another."""
    weight = np.diag(np.tile(1.0 / PRIOR_STD, r.shape[1] // 10))
    return np.vstack([r, weight]), np.r_[b, weight @ centre.ravel()]
