"""The paper's three baselines: a network, a committee, a Gaussian process, in its sizes."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from scipy import linalg, optimize

from adapter import optional
from adapter.errors import ModelError
from adapter.experiments.baselines.learner import (
    Progress,
    ScaledBaseline,
    Told,
    gram,
    solve_positive,
)
from adapter.model.spatial import Array

MEMBERS, UNITS, POINTS = 50, 4000, 10_000  # machines, units of each; samples, also of the process
# (share of the epochs, share of ADAM's first rate): constant rates leave the loss where their
# noise is.
SCHEDULE = ((0.35, 1.0), (0.3, 0.5), (0.2, 0.15), (0.15, 0.05))
# Bounds of the length scales, in deviations of an input, and of the share of noise in variance.
LENGTHS = (0.3, 300.0)
NOISES = (1e-9, 1.0)


class FeedForward(ScaledBaseline):
    """The first: tanh units in one hidden layer of scikit-learn's, trained by ADAM.

    Inputs and outputs are standardised.
    """

    at_once = 20_000  # so that the hidden layer stays below 100 MB

    def __init__(
        self,
        units: int = 1000,
        epochs: int = 120,
        batch: int = 200,
        rate: float = 2e-3,
        seed: int = 0,
    ) -> None:
        """Nothing is imported before `fit`.

        Args:
            units: of the hidden layer.
            epochs: passes over all samples; the rate falls as in `SCHEDULE`.
            batch: samples of one step.
            rate: of ADAM at the start.
            seed: of the weights and of the order of samples.
        """
        self.units, self.epochs, self.batch = units, epochs, batch
        self.rate, self.seed = rate, seed

    def _learn_scaled(self, x: Array, y: Array, progress: Progress) -> Told:
        """Train on all samples in float32. Raises MeansError without scikit-learn."""
        regressor = optional.load("sklearn.neural_network").MLPRegressor
        x, y = x.astype(np.float32), y.astype(np.float32)
        self._net = regressor(
            hidden_layer_sizes=(self.units,),
            activation="tanh",
            solver="adam",
            alpha=0.0,
            batch_size=min(self.batch, len(x)),
            tol=0.0,
            n_iter_no_change=self.epochs + 1,  # never stop early
            warm_start=True,
            random_state=self.seed,
        )
        for share, part in SCHEDULE:
            epochs, rate = max(1, round(share * self.epochs)), part * self.rate
            self._net.set_params(learning_rate_init=rate, max_iter=epochs)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it stopped at the last epoch, as told to
                self._net.fit(x, y if y.shape[1] > 1 else y[:, 0])
            progress(f"network: {epochs} epochs at rate {rate:g}, loss {self._net.loss_:.2e}")
        own = {"units": self.units, "epochs": self.epochs}
        rates = ", ".join(f"{part * self.rate:g} for {share:.0%}" for share, part in SCHEDULE)
        return {**own, "samples": len(x), "inputs": x.shape[1]}, (
            "Inputs and outputs at zero mean and unit deviation, float32, no weight decay.",
            f"ADAM with batches of {self.batch} for {self.epochs} epochs, its rate falling in "
            f"steps: {rates} of the epochs.",
        )

    def _answer_scaled(self, x: Array) -> Array:
        found = self._net.predict(x.astype(np.float32))
        return np.asarray(found.reshape(len(x), -1), dtype=np.float64)


class ElmCommittee(ScaledBaseline):
    """The second: a committee of extreme learning machines (Huang et al. 2006).

    A machine is a hidden layer of random tanh units that are never trained and output weights by
    ridge regression, on standardised inputs and outputs. Each has its own units and its own random
    part of the samples; the committee's answer is the mean. All in float64: with so weak a ridge
    the units' Gram matrix is not positive definite in float32.
    """

    at_once = 5_000  # so that the hidden layer stays below 160 MB

    def __init__(
        self,
        members: int = MEMBERS,
        units: int = UNITS,
        points: int = POINTS,
        spread: float = 0.2,
        ridge: float = 1e-9,
        seed: int = 0,
    ) -> None:
        """Nothing is computed before `fit`.

        Args:
            members: machines in the committee.
            units: tanh units of each.
            points: samples of each, drawn without repetition from all (fewer where there are
                not so many).
            spread: deviation of a unit's input for standardised, independent x. Small ones keep
                the units close to their linear part, so that their sums are low polynomials.
            ridge: added to the mean Gram matrix of the units.
            seed: of weights and parts.
        """
        self.members, self.units, self.points = members, units, points
        self.spread, self.ridge, self.seed = spread, ridge, seed

    def _learn_scaled(self, x: Array, y: Array, progress: Progress) -> Told:
        """Train every member on its own part. Raises ModelError for too weak a ridge."""
        self._machines: list[tuple[Array, Array, Array]] = []
        points = min(self.points, len(x))
        for member in range(self.members):
            rng = np.random.default_rng([self.seed, member])
            rows = rng.choice(len(x), points, replace=False)
            self._machines.append(self._machine(x[rows], y[rows], rng))
            progress(f"committee: machine {member + 1} of {self.members}")
        inputs = x.shape[1]
        sizes = {"members": self.members, "units": self.units, "points": points, "inputs": inputs}
        return sizes, (
            f"Random input weights with deviation {self.spread:g} / sqrt({inputs}) on standardised "
            "inputs, biases uniform in -1 to 1.",
            f"Output weights by ridge regression, ridge {self.ridge:g} on the mean Gram matrix, "
            "float64 (float32 is not positive definite there).",
        )

    def _machine(self, x: Array, y: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Weights and biases of units tanh(x weights + biases), and the output weights."""
        weights = rng.normal(size=(x.shape[1], self.units)) * self.spread / np.sqrt(x.shape[1])
        biases = rng.uniform(-1.0, 1.0, self.units)
        hidden = np.tanh(x @ weights + biases)
        normal = gram(hidden)
        normal[np.diag_indices(self.units)] += self.ridge * len(x)
        try:
            output = solve_positive(normal, hidden.T @ y)
        except linalg.LinAlgError:
            raise ModelError(
                f"the units' Gram matrix is singular in float64; take a ridge above {self.ridge:g}"
            ) from None
        return weights, biases, output

    def _answer_scaled(self, x: Array) -> Array:
        """The mean over the committee."""
        every = sum(np.tanh(x @ w + b) @ output for w, b, output in self._machines)
        return np.asarray(every) / len(self._machines)


class GaussianProcess(ScaledBaseline):
    """The third: Gaussian process regression (Rasmussen, Williams 2006) on standardised numbers.

    One squared-exponential kernel with a length scale by input serves all outputs; each output has
    a signal variance of its own, which drops out of the optimum. Own code instead of
    scikit-learn's: that one shares the signal variance too, and its gradient by length scale holds
    points² x inputs numbers, where two matrix products do.
    """

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
        how: dict[str, Any] = {"jac": True, "method": "L-BFGS-B", "bounds": bounds}
        how["options"] = {"maxiter": self.steps}
        found = optimize.minimize(negative_log_likelihood, start, (x, y), **how)
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
    for _ in range(6):  # the kernel may be singular in float64
        gram = kernel(kept, kept)
        gram[np.diag_indices(len(gram))] += noise
        try:
            return solve_positive(gram, y), noise
        except linalg.LinAlgError:
            noise *= 10.0
    raise ModelError(f"the kernel of the points is singular even with {noise:.1e} of noise")
