"""How far torques that λ and θ predict lie from measured ones, over a whole table of samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.learning.batch.prediction_errors import predicted_torques, relative_errors
from adapter.learning.tree_data import TreeData


class TorqueErrors(NamedTuple):
    """Errors of joint torques (a base's wrench is not among them).

    Attributes:
        median, p99: of eq. 20 over all joints where the measured torque exceeds 0.1 N m.
        rmse: (n,) N m.
    """

    median: float
    p99: float
    rmse: np.ndarray


def torque_errors(data: TreeData, lam: np.ndarray, theta: np.ndarray) -> TorqueErrors:
    """Errors on samples; arguments as for `predicted_torques`."""
    first = data.tree.rows - data.tree.n
    measured = data.tau[:, first:]
    predicted = predicted_torques(data, lam, theta)[:, first:]
    error = relative_errors(measured, predicted)
    every = error[~np.isnan(error)]
    median, p99 = np.quantile(every, (0.5, 0.99)) if len(every) else (np.nan, np.nan)
    rmse = np.sqrt(np.mean((measured - predicted) ** 2, axis=0))
    return TorqueErrors(float(median), float(p99), rmse)
