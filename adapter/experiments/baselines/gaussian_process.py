"""Gaussian process regression (Rasmussen, Williams 2006), the paper's third baseline.

One squared-exponential kernel with a length scale by input serves all outputs; each output has a
signal variance of its own, which drops out of the optimum. Own code instead of scikit-learn's:
that one shares the signal variance too, and its gradient by length scale holds points² x inputs
numbers, where two matrix products do.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg, optimize

from adapter.errors import ModelError
from adapter.experiments.baselines.dense import solve_positive
from adapter.experiments.baselines.learner import Progress, ScaledBaseline, Told
from adapter.model.spatial import Array

POINTS = 10_000  # the paper's
# Bounds of the length scales, in deviations of an input, and of the share of noise in variance.
LENGTHS = (0.3, 300.0)
NOISES = (1e-9, 1.0)
# The share of noise is raised by this, a few times, where the kernel is singular in float64.
RAISE, RAISES = 10.0, 6


class GaussianProcess(ScaledBaseline):
    """Gaussian process regression on standardised inputs and outputs."""

    at_once = 2_000  # so that their kernel stays below 160 MB

    def __init__(
        self, points: int = POINTS, tuned_on: int = 1500, steps: int = 60, seed: int = 0
    ) -> None:
        """Nothing is computed before `fit`.

        Args:
            points: samples that the process keeps, drawn from all (fewer where there are not so
                many).
            tuned_on: how many of these find the length scales and the noise.
            steps: of L-BFGS on the marginal likelihood, at most.
            seed: of the draw.
        """
        self.points, self.tuned_on, self.steps, self.seed = points, tuned_on, steps, seed

    def _learn_scaled(self, x: Array, y: Array, progress: Progress) -> Told:
        """Find length scales and noise on some points, then solve for all of them exactly."""
        rng = np.random.default_rng(self.seed)
        rows = rng.choice(len(x), min(self.points, len(x)), replace=False)
        x, y = x[rows], y[rows]
        self._lengths, noise = self._tuned(x[: self.tuned_on], y[: self.tuned_on])
        progress(f"Gaussian process: share of noise {noise:.1e}; solving {len(x)} points")
        self._kept = x / self._lengths
        self._alpha, noise = _solved(self._kept, y, noise)
        tuned_on = min(self.tuned_on, len(x))
        low, high = self._lengths.min(), self._lengths.max()
        bound = " (its lower bound)" if noise <= NOISES[0] * (1.0 + 1e-6) else ""
        return {"points": len(x), "tuned_on": tuned_on, "inputs": len(self._lengths)}, (
            f"One length scale by input ({low:.2g} to {high:.2g} deviations) and the share of "
            f"noise {noise:.1e}{bound} by marginal likelihood on {tuned_on} points, L-BFGS from "
            f"equal lengths, at most {self.steps} steps; one kernel for all joints.",
            "Exact solution by Cholesky in float64 on all points.",
        )

    def _tuned(self, x: Array, y: Array) -> tuple[Array, float]:
        """Length scales (width,) and share of noise where the marginal likelihood is highest."""
        start = np.append(np.full(x.shape[1], np.log(np.sqrt(x.shape[1]))), np.log(1e-4))
        bounds = [tuple(np.log(LENGTHS))] * x.shape[1] + [tuple(np.log(NOISES))]
        found = optimize.minimize(
            negative_log_likelihood,
            start,
            (x, y),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": self.steps},
        )
        return np.exp(found.x[:-1]), float(np.exp(found.x[-1]))

    def _answer_scaled(self, x: Array) -> Array:
        """The mean of the process."""
        mean: Array = kernel(x / self._lengths, self._kept) @ self._alpha
        return mean


def kernel(first: Array, second: Array) -> Array:
    """exp(-|x - z|²/2) between rows of (m, width) and (k, width), (m, k)."""
    product = first @ second.T
    product -= 0.5 * np.square(first).sum(axis=1)[:, None]
    product -= 0.5 * np.square(second).sum(axis=1)
    np.minimum(product, 0.0, out=product)  # rounding must not make a kernel above 1
    return np.asarray(np.exp(product, out=product), dtype=np.float64)


def negative_log_likelihood(logs: Array, x: Array, y: Array) -> tuple[float, Array]:
    """Minus the log marginal likelihood of all outputs, up to a constant, and its gradient.

    The signal variance of output o is at its optimum yᵀ K⁻¹ y / m, K = kernel + noise 1.

    Args:
        logs: (width + 1,) logarithms of the length scales and of the share of noise.
        x: (m, width) inputs; y: (m, outputs).
    """
    lengths, noise = np.exp(logs[:-1]), float(np.exp(logs[-1]))
    scaled = x / lengths
    smooth = kernel(scaled, scaled)
    try:
        factor = linalg.cholesky(smooth + noise * np.eye(len(x)), lower=True)
    except linalg.LinAlgError:
        return 1e25, np.zeros_like(logs)  # a wall: the line search steps back
    inverse = linalg.cho_solve((factor, True), np.eye(len(x)))
    alpha = inverse @ y
    variance = np.maximum(np.sum(y * alpha, axis=0) / len(x), np.finfo(float).tiny)
    outputs = y.shape[1]
    value = outputs * np.log(np.diag(factor)).sum() + 0.5 * len(x) * np.log(variance).sum()
    # dL/dK, then through K_ij = exp(-|x_i - x_j|²/2) by the logarithm of each length scale.
    by_kernel = 0.5 * (outputs * inverse - (alpha / variance) @ alpha.T)
    w = by_kernel * smooth
    by_lengths = 2.0 * (w.sum(axis=1) @ np.square(scaled) - np.sum(scaled * (w @ scaled), axis=0))
    return float(value), np.append(by_lengths, noise * np.trace(by_kernel))


def _solved(kept: Array, y: Array, noise: float) -> tuple[Array, float]:
    """K⁻¹ y (m, outputs), and the share of noise that let K be factorised."""
    for _ in range(RAISES):
        gram = kernel(kept, kept)
        gram[np.diag_indices(len(gram))] += noise
        try:
            return solve_positive(gram, y), noise
        except linalg.LinAlgError:
            noise *= RAISE
    raise ModelError(f"the kernel of the points is singular even with {noise:.1e} of noise")
