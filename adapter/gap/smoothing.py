"""The motion behind noisy q and dq: one smoothing spline per joint through both.

Noise in q and dq sits in every regressor; a spline that both signals share, as stiff as the
data allow, leaves little of it. The stiffness of each joint is the one with the highest marginal
likelihood, the noise levels being those of the data's high frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar
from scipy.sparse import diags

from adapter.filters import noise_from_samples
from adapter.records import Array

DEGREE = 5
KNOT_S = 0.02  # a joint does nothing that we model within 40 ms
Q_NOISE_FLOOR, DQ_NOISE_FLOOR = 2e-6, 2e-5  # rad, rad/s: of signals without noise
STIFFNESS = (-16.0, 6.0)  # range of ln of the penalty on the squared third derivative


@dataclass(frozen=True)
class Smoothed:
    """Splines of all joints.

    Attributes:
        spline: q(t), (n,) at a time; its derivatives are dq and ddq.
        q_noise, dq_noise: (n,) noise levels that were assumed.
    """

    spline: BSpline
    q_noise: Array
    dq_noise: Array

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) at times t (m,), s."""
        return tuple(np.asarray(self.spline(t, nu)) for nu in range(3))  # type: ignore[return-value]


def smooth_motion(t: Array, q: Array, dq: Array, dq_late_s: float = 0.0) -> Smoothed:
    """Splines through q and dq.

    Args:
        t: (m,) s, increasing; q, dq: (m, n) rad, rad/s.
        dq_late_s: how much later dq is than q.
    """
    count = max(2, int(np.ceil((t[-1] - t[0]) / KNOT_S)))
    inner = np.linspace(t[0], t[-1], count + 1)
    knots = np.concatenate([np.full(DEGREE, t[0]), inner, np.full(DEGREE, t[-1])])
    level = BSpline.design_matrix(t, knots, DEGREE)
    when = np.clip(t - dq_late_s, t[0], t[-1])
    slope = _derivative_design(when, knots)
    q_noise = np.maximum(noise_from_samples(q), Q_NOISE_FLOOR)
    dq_noise = np.maximum(noise_from_samples(dq), DQ_NOISE_FLOOR)
    rough = _roughness(knots)
    bands_q, bands_dq, bands_rough = (_bands(x) for x in (level.T @ level, slope.T @ slope, rough))
    coefficients = np.empty((level.shape[1], q.shape[1]))
    for j in range(q.shape[1]):
        wq, wdq = q_noise[j] ** -2, dq_noise[j] ** -2
        data = wq * bands_q + wdq * bands_dq
        right = wq * (level.T @ q[:, j]) + wdq * (slope.T @ dq[:, j])
        coefficients[:, j] = _stiffest(data, right, bands_rough)
    return Smoothed(BSpline(knots, coefficients, DEGREE), q_noise, dq_noise)


def _stiffest(data: Array, right: Array, rough: Array) -> Array:
    """Coefficients at the penalty with the highest marginal likelihood."""
    rank = data.shape[1] - 3

    def cost(log_penalty: float) -> float:
        factor = cholesky_banded(data + np.exp(log_penalty) * rough, lower=True)
        solution = cho_solve_banded((factor, True), right)
        return float(2.0 * np.log(factor[0]).sum() - rank * log_penalty - right @ solution)

    best = minimize_scalar(cost, bounds=STIFFNESS, method="bounded", options={"xatol": 0.2})
    factor = cholesky_banded(data + np.exp(best.x) * rough, lower=True)
    return np.asarray(cho_solve_banded((factor, True), right))


def _derivative_design(t: Array, knots: Array) -> Any:
    """Sparse matrix of the basis functions' first derivatives at t."""
    lower = BSpline.design_matrix(t, knots[1:-1], DEGREE - 1)
    size = len(knots) - DEGREE - 1
    gain = DEGREE / (knots[DEGREE + 1 : DEGREE + size] - knots[1:size])
    return lower @ _differences(gain, size)


def _differences(gain: Array, size: int) -> Any:
    """Sparse (size - 1, size): differences of neighbours times gain (size - 1,)."""
    bands: Any = [-gain, gain]
    return diags(bands, offsets=[0, 1], shape=(size - 1, size))


def _roughness(knots: Array) -> Any:
    """Integral of products of third derivatives of the basis functions, sparse."""
    degree, size = DEGREE, len(knots) - DEGREE - 1
    product: Any = None
    inner = knots
    for _ in range(3):
        gain = degree / (inner[degree + 1 : degree + size] - inner[1:size])
        step = _differences(gain, size)
        product = step if product is None else step @ product
        inner, degree, size = inner[1:-1], degree - 1, size - 1
    # degree-2 splines: exact with three Gauss points per knot interval
    edges = np.unique(inner)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    half = 0.5 * np.diff(edges)
    points = (edges[:-1, None] + half[:, None] * (1.0 + nodes)).ravel()
    basis = BSpline.design_matrix(points, inner, degree)
    mass = basis.T @ diags((half[:, None] * weights).ravel()) @ basis
    return product.T @ mass @ product


def _bands(matrix: Any) -> Array:
    """Lower bands (DEGREE + 1, size) of a sparse symmetric matrix."""
    size = matrix.shape[0]
    out = np.zeros((DEGREE + 1, size))
    for k in range(DEGREE + 1):
        out[k, : size - k] = matrix.diagonal(-k)
    return out
