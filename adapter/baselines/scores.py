"""Relative torque errors as the paper's Fig. 5 shows them: boxes by joint, eq. 20."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.spatial import Array

# Smaller torques are not judged by their relative error, N m (the choice).
LEAST_TORQUE = 0.1
# Of a box: whisker, quartile, median, quartile, whisker.
BOX_PERCENTILES = (5.0, 25.0, 50.0, 75.0, 95.0)


@dataclass(frozen=True)
class Score:
    """How well torques (m, n) were met. Relative errors are shares, not per cent.

    Attributes:
        boxes: (n, 5) relative errors at `BOX_PERCENTILES`, by joint; NaN for a joint whose
            torque is never large enough to be judged.
        judged: (n,) number of samples judged.
        rmse: (n,) N m, over all samples.
        median, p99: of the judged samples of all joints together; NaN without any.
    """

    boxes: Array
    judged: np.ndarray
    rmse: Array
    median: float
    p99: float


def relative_errors(tau: Array, estimate: Array) -> Array:
    """Eq. 20 by sample and joint, (m, n), in 0 to 2; NaN where |tau| is at most `LEAST_TORQUE`.

    Raises:
        ModelError: tables of different shapes, or an estimate that is not finite.
    """
    if tau.shape != estimate.shape or tau.ndim != 2:
        raise ModelError(f"torques {tau.shape} and estimates {estimate.shape} must be like tables")
    if not np.isfinite(estimate).all():
        raise ModelError("the estimated torques are not all finite")
    judged = np.abs(tau) > LEAST_TORQUE
    larger = np.maximum(np.abs(tau), np.abs(estimate))
    error = np.abs(tau - estimate) / np.where(judged, larger, 1.0)
    return np.where(judged, error, np.nan)


def score(tau: Array, estimate: Array) -> Score:
    """Boxes, root mean square errors and overall percentiles of estimates (m, n), N m.

    Raises:
        ModelError: see `relative_errors`.
    """
    errors = relative_errors(tau, estimate)
    judged = ~np.isnan(errors)
    boxes = np.array([_percentiles(e[k]) for e, k in zip(errors.T, judged.T, strict=True)])
    rmse = np.sqrt(np.mean(np.square(tau - estimate), axis=0))
    every = errors[judged]
    median, p99 = np.percentile(every, (50.0, 99.0)) if len(every) else (np.nan, np.nan)
    return Score(boxes, judged.sum(axis=0), rmse, float(median), float(p99))


def _percentiles(errors: Array) -> Array:
    if not len(errors):
        return np.full(len(BOX_PERCENTILES), np.nan)
    return np.asarray(np.percentile(errors, BOX_PERCENTILES), dtype=np.float64)
