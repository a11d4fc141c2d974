"""How far predicted torques lie from measured ones: the paper's relative error, and N m."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from adapter.dynamics import inverse_dynamics
from adapter.kinematics import DTYPE
from adapter.spatial import Array
from adapter.tree_data import TreeData

CHUNK = 4096  # samples predicted at a time
SMALLEST_TORQUE = 0.1  # N m; the relative error of less than this says nothing (issue)


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
    """τ (m, rows) of λ (n, 6) and θ (bodies, 10) for the samples' motion, N m."""
    lam_t, theta_t = (torch.as_tensor(x, dtype=DTYPE) for x in (lam, theta))
    out = np.empty_like(data.tau)
    with torch.no_grad():
        for start in range(0, len(data), CHUNK):
            rows = slice(start, start + CHUNK)
            part = data.take(rows)
            base = part.base.torch()
            out[rows] = inverse_dynamics(data.tree, lam_t, theta_t, *part.joint_signals(), base)
    return out


def relative_error(measured: Array, predicted: Array) -> Array:
    """Eq. 20: |τ - τ̂| / max(|τ|, |τ̂|); zero where both are."""
    larger = np.maximum(np.abs(measured), np.abs(predicted))
    gap = np.abs(measured - predicted)
    return np.asarray(np.divide(gap, larger, out=np.zeros_like(gap), where=larger > 0.0))


def torque_errors(data: TreeData, lam: Array, theta: Array) -> TorqueErrors:
    """Errors on samples; arguments as for `predicted_torques`."""
    first = data.tree.rows - data.tree.n
    measured = data.tau[:, first:]
    predicted = predicted_torques(data, lam, theta)[:, first:]
    error, counts = relative_error(measured, predicted), np.abs(measured) > SMALLEST_TORQUE
    by_joint = tuple(np.sort(error[counts[:, j], j]) for j in range(data.tree.n))
    every = np.concatenate(by_joint)
    median, p99 = (
        (float(np.quantile(every, q)) for q in (0.5, 0.99)) if len(every) else (np.nan, np.nan)
    )
    rmse = np.sqrt(np.mean((measured - predicted) ** 2, axis=0))
    return TorqueErrors(by_joint, median, p99, np.asarray(rmse))
