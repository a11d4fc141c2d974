"""Least squares over bodies that can exist, as the convex problem it is: an interior point's path.

Minimised is `t/2 |R θ - b|² + Σ_bodies tr(P_ref⁻¹ P) - log det P` with P the pseudo-inertia,
linear in θ: the entropic divergence of Lee, Wensing and Park (2020) keeps every body possible and
gives what the data don't show a size. Newton's method follows the minimum while the target walks
from what the start explains to b (the straight line between possible bodies is possible all
along), then while t grows. Where that line leads along the edge of what is possible the walk can
end early; the path then starts at the reference bodies, which are the minimum at t = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.inertia import is_consistent, pseudo_inertia
from adapter.offline.theta_factors import PER_BODY
from adapter.spatial import Array

# A body of no particular size, kg and m (radius of gyration); what nothing shows goes there.
REFERENCE_MASS, REFERENCE_RADIUS = 10.0, 0.3
NEWTON_STEPS = 20  # on the way to the target; more mean that it walks too fast
LAST_STEPS = 60  # at each t
WALK_STEPS = 400  # in all; ATLAS takes 30, and the path from the reference bodies 150
CENTRED = 1e-2  # Newton decrement squared at which a point of the path is good enough
FIRST_STRIDE, SMALLEST_STRIDE = 0.1, 1e-6
GROWTH = 10.0  # of t
SMALLEST_GROWTH = 1.2
LARGEST_T = 1e9  # to which t grows in any case
GAP = 1e-7  # stop where what better centring could gain is this share of the cost
# A cost this far above the best, as a share of half |b|², is nothing: torques right to 1e-7.
NEGLIGIBLE = 1e-14
LAST_T = 1e14  # to which t grows until the gap is negligible; beyond, rounding leads nowhere
_BASIS = pseudo_inertia(np.eye(PER_BODY))


@dataclass(frozen=True)
class Reached:
    """Where the path ended.

    Attributes:
        theta: (bodies, 10) possible bodies.
        steps: Newton steps taken.
        gap: half the weighted sum of squares lies at most this far above the best of possible
            bodies; infinite where no point of the path was centred.
        close: whether that is within `GAP` of the cost (if not, the data leave so little that a
            polish without barrier is worth its while).
    """

    theta: Array
    steps: int
    gap: float
    close: bool


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

    def cost(self, x: Array) -> float:
        """Half the sum of squares."""
        left = self.r @ x - self.b
        return 0.5 * float(left @ left)

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

    def gap(self, x: Array) -> float:
        """How far the cost of a centred point lies above the best of possible bodies, at most.

        There t times the cost's gradient is Σ P⁻¹ - P_ref⁻¹, and its product with the way to
        the best point at most 4 a body and tr(P_ref⁻¹ P) of that point, which is about x's.
        """
        return float(4 * len(x) / PER_BODY + self.pull @ x) / self.t


def interior_point(r: Array, b: Array, start: Array | None = None) -> Reached:
    """Possible bodies close to the least squares of R θ = b.

    Args:
        r: (k, 10 bodies); b: (k,).
        start: (bodies, 10) bodies to walk from; None, or where one of them is impossible or the
            walk gets stuck: from the reference bodies.
    """
    bodies = r.shape[1] // PER_BODY
    path = _Path(r, b, 1.0, r.T @ r, np.tile(_reference_pull(), bodies))
    x, steps, arrived = None, 0, False
    if start is not None and is_consistent(start):
        x, steps, arrived = _walk(path, start.ravel().copy(), b)
    if x is None or not arrived:
        x = np.tile(reference_body(), bodies)
        path.t = 1.0 / max(path.cost(x), 1.0)
    x, count, gap, close = _grow(path, x)
    return Reached(x.reshape(bodies, PER_BODY), steps + count, gap, close)


def reference_body() -> Array:
    """θ (10,) of the body of no particular size."""
    tensor = 2.0 * REFERENCE_MASS * REFERENCE_RADIUS**2
    return np.array([REFERENCE_MASS, 0.0, 0.0, 0.0, tensor, 0.0, 0.0, tensor, 0.0, tensor])


def _reference_pull() -> Array:
    """tr(P_ref⁻¹ P) as a linear form (10,) of θ."""
    inverse = np.linalg.inv(pseudo_inertia(reference_body()))
    return np.asarray(np.einsum("ij,kji->k", inverse, _BASIS))


def _walk(path: _Path, x: Array, b: Array) -> tuple[Array, int, bool]:
    """Follow the minimum while the target goes from what x explains to b; whether it arrives."""
    first = path.r @ x
    done, stride, steps = 0.0, FIRST_STRIDE, 0
    while done < 1.0 and stride > SMALLEST_STRIDE and steps < WALK_STEPS:
        there = min(1.0, done + stride)
        path.b = first + there * (b - first)
        found, count, centred = path.centre(x, NEWTON_STEPS)
        steps += count
        if centred:
            x, done, stride = found, there, 2.0 * stride
        else:
            stride *= 0.3
    path.b = b
    return x, steps, done >= 1.0


def _grow(path: _Path, x: Array) -> tuple[Array, int, float, bool]:
    """Follow the minimum while t grows: the last point, Newton steps, gap, whether it is close.

    A point that is not centred is tried again with a smaller growth.
    """
    steps, gap, growth, reached = 0, np.inf, GROWTH, path.t
    enough = NEGLIGIBLE * 0.5 * float(path.b @ path.b)
    while growth > SMALLEST_GROWTH and reached < (LARGEST_T if gap <= enough else LAST_T):
        path.t = reached * growth
        found, count, centred = path.centre(x, LAST_STEPS)
        steps += count
        if not centred:
            growth = np.sqrt(growth)
            continue
        x, reached, gap = found, path.t, path.gap(found)
        growth = min(GROWTH, growth**2)
        if gap < GAP * path.cost(x):
            return x, steps, gap, True
    return x, steps, gap, False
