"""How far predicted torques lie from measured ones: the paper's relative error, and N m."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from adapter.dynamics import inverse_dynamics
from adapter.errors import ModelError
from adapter.kinematics import DTYPE
from adapter.offline.finite import check_dynamics, check_finite
from adapter.offline.theta_factors import PER_BODY
from adapter.spatial import Array
from adapter.tree_data import TreeData

CHUNK = 4096  # samples predicted at a time
LEAST_TORQUE = 0.1  # N m; the relative error of a smaller torque says nothing (our choice)


@dataclass(frozen=True)
class TorqueErrors:
    """Errors of joint torques (a base's wrench is not among them).

    Attributes:
        relative: for each joint eq. 20 where the measured torque exceeds 0.1 N m, sorted.
        median, p99: of all joints together.
        rmse: (n,) N m.
    """

    relative: tuple[Array, ...]
    median: float
    p99: float
    rmse: Array


def predicted_torques(data: TreeData, lam: Array, theta: Array) -> Array:
    """τ (m, rows) of λ (n, 6) and θ (bodies, 10) for the samples' motion, N m.

    Raises:
        ModelError: λ or θ of another shape, or numbers that are not finite.
    """
    wanted = (data.tree.n, 6), (data.tree.bodies, PER_BODY)
    if (lam.shape, theta.shape) != wanted:
        raise ModelError(f"λ and θ must have shapes {wanted}, got {lam.shape} and {theta.shape}")
    check_dynamics(data)
    check_finite({"λ": lam, "θ": theta})
    lam_t, theta_t = (torch.as_tensor(x, dtype=DTYPE) for x in (lam, theta))
    out = np.empty_like(data.tau)
    with torch.no_grad():
        for start in range(0, len(data), CHUNK):
            rows = slice(start, start + CHUNK)
            part = data.take(rows)
            base = part.base.torch()
            out[rows] = inverse_dynamics(data.tree, lam_t, theta_t, *part.joint_signals(), base)
    return out


def relative_errors(tau: Array, estimate: Array) -> Array:
    """Eq. 20 by sample and joint, (m, n), in 0 to 2; NaN where |tau| is at most `LEAST_TORQUE`.

    Raises:
        ModelError: tables of different shapes, or numbers that are not finite.
    """
    if tau.shape != estimate.shape or tau.ndim != 2:
        raise ModelError(f"torques {tau.shape} and estimates {estimate.shape} must be like tables")
    check_finite({"measured torque": tau, "estimated torque": estimate})
    judged = np.abs(tau) > LEAST_TORQUE
    larger = np.maximum(np.abs(tau), np.abs(estimate))
    error = np.abs(tau - estimate) / np.where(judged, larger, 1.0)
    return np.where(judged, error, np.nan)


def torque_errors(data: TreeData, lam: Array, theta: Array) -> TorqueErrors:
    """Errors on samples; arguments as for `predicted_torques`."""
    first = data.tree.rows - data.tree.n
    measured = data.tau[:, first:]
    predicted = predicted_torques(data, lam, theta)[:, first:]
    error = relative_errors(measured, predicted)
    by_joint = tuple(np.sort(column[~np.isnan(column)]) for column in error.T)
    every = np.concatenate(by_joint)
    median, p99 = (
        (float(np.quantile(every, q)) for q in (0.5, 0.99)) if len(every) else (np.nan, np.nan)
    )
    rmse = np.sqrt(np.mean((measured - predicted) ** 2, axis=0))
    return TorqueErrors(by_joint, median, p99, np.asarray(rmse))
