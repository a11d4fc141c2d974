"""Least squares over bodies that can exist, as the convex problem it is: an interior point's path.

Minimised is `t/2 |R θ - b|² + Σ_bodies tr(P_ref⁻¹ P) - log det P` with P the pseudo-inertia,
linear in θ: the entropic divergence of Lee, Wensing and Park (2020) keeps every body possible and
gives what the data don't show a size. Newton's method follows the minimum while the target walks
from what the start explains to b (the straight line between possible bodies is possible all
along), then while t grows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.inertia import pseudo_inertia
from adapter.offline.theta_factors import PER_BODY
from adapter.spatial import Array

# A body of no particular size, kg and m (radius of gyration); what nothing shows goes there.
REFERENCE_MASS, REFERENCE_RADIUS = 10.0, 0.3
NEWTON_STEPS = 20  # on the way to the target; more mean that it walks too fast
LAST_STEPS = 60  # at each t
CENTRED = 1e-2  # Newton decrement squared at which a point of the path is good enough
FIRST_STRIDE, SMALLEST_STRIDE = 0.1, 1e-6
GROWTH = 10.0  # of t
LARGEST_T = 1e9
GAP = 1e-7  # stop where what better centring could gain is this share of the cost
_BASIS = pseudo_inertia(np.eye(PER_BODY))


@dataclass
class _Path:
    """The problem at weight t and target b, in the flat θ (10 bodies,)."""

    r: Array
    b: Array
    t: float
    moments: Array
    pull: Array

    def value(self, x: Array) -> float:
        """The minimised sum; infinite where a body is impossible."""
        try:
            lower = np.linalg.cholesky(pseudo_inertia(x.reshape(-1, PER_BODY)))
        except np.linalg.LinAlgError:
            return np.inf
        left = self.r @ x - self.b
        logs = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum()
        return float(0.5 * self.t * (left @ left) + self.pull @ x - 2.0 * logs)

    def newton(self, x: Array) -> tuple[Array, float]:
        """Newton's step and its decrement squared."""
        inverse = np.linalg.inv(pseudo_inertia(x.reshape(-1, PER_BODY)))
        turned = np.einsum("bij,kjl->bkil", inverse, _BASIS)
        gradient = self.t * (self.r.T @ (self.r @ x - self.b)) + self.pull
        gradient -= np.einsum("bkii->bk", turned).ravel()
        curvature = self.t * self.moments
        for k, block in enumerate(np.einsum("bkil,bmli->bkm", turned, turned)):
            at = slice(PER_BODY * k, PER_BODY * (k + 1))
            curvature[at, at] += block
        scale = 1.0 / np.sqrt(np.diag(curvature))
        step = -scale * np.linalg.solve(curvature * np.outer(scale, scale), scale * gradient)
        return step, float(-gradient @ step)

    def centre(self, x: Array, most: int) -> tuple[Array, int, bool]:
        """Newton's method from x: where it got, in how many steps, whether it is centred."""
        for count in range(most):
            try:
                step, decrement = self.newton(x)
            except np.linalg.LinAlgError:  # a body at the edge of what is possible
                return x, count, False
            if not np.isfinite(decrement):
                return x, count, False
            if decrement < CENTRED:
                return x, count, True
            scale = self._along(x, step, decrement)
            if scale == 0.0:
                return x, count, False
            x = x + scale * step
        return x, most, False

    def _along(self, x: Array, step: Array, decrement: float) -> float:
        """How far along a step: further than Newton says where that goes down still."""
        here, scale = self.value(x), 1.0
        found = self.value(x + step)
        while not found < here - 0.1 * scale * decrement:
            scale *= 0.5
            if scale < 1e-10:
                return 0.0
            found = self.value(x + scale * step)
        while scale >= 1.0 and (further := self.value(x + 2.0 * scale * step)) < found:
            scale, found = 2.0 * scale, further
        return scale


def interior_point(r: Array, b: Array, start: Array) -> tuple[Array, int, bool]:
    """Possible bodies close to the least squares of R θ = b.

    Args:
        r: (k, 10 bodies); b: (k,).
        start: (bodies, 10) possible bodies.

    Returns:
        θ (bodies, 10), Newton steps taken, and whether it lies within `GAP` of the optimum (if
        not, the data leave so little that a polish without barrier is worth its while).
    """
    bodies = len(start)
    size = REFERENCE_RADIUS**2
    reference = np.linalg.inv(REFERENCE_MASS * np.diag([size, size, size, 1.0]))
    pull = np.tile(np.einsum("ij,kji->k", reference, _BASIS), bodies)
    x = start.ravel().copy()
    path = _Path(r, b, 1.0, r.T @ r, pull)
    x, steps = _walk(path, x, b)
    good, close = x, False
    while path.t < LARGEST_T:
        path.t *= GROWTH
        x, count, centred = path.centre(x, LAST_STEPS)
        steps += count
        if not (centred or np.isfinite(path.value(x))):
            break
        good = x
        left = r @ x - b
        if 4 * bodies / path.t < GAP * 0.5 * float(left @ left):
            close = True
            break
    return good.reshape(start.shape), steps, close


def _walk(path: _Path, x: Array, b: Array) -> tuple[Array, int]:
    """Follow the minimum while the target goes from what x explains to b."""
    first = path.r @ x
    done, stride, steps = 0.0, FIRST_STRIDE, 0
    while done < 1.0 and stride > SMALLEST_STRIDE:
        there = min(1.0, done + stride)
        path.b = first + there * (b - first)
        found, count, centred = path.centre(x, NEWTON_STEPS)
        steps += count
        if centred:
            x, done, stride = found, there, 2.0 * stride
        else:
            stride *= 0.3
    path.b = b
    return x, steps
