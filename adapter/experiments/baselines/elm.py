"""A committee of extreme learning machines (Huang et al. 2006), the paper's second baseline.

A machine is a hidden layer of random tanh units that are never trained and output weights by
ridge regression. Each has its own units and its own random part of the samples; the committee's
answer is the mean. All in float64: with so weak a ridge the units' Gram matrix is not positive
definite in float32.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from adapter.errors import ModelError
from adapter.experiments.baselines.dense import gram, solve_positive
from adapter.experiments.baselines.learner import Progress, ScaledBaseline, Told
from adapter.model.spatial import Array

MEMBERS, UNITS, POINTS = 50, 4000, 10_000  # the paper's


class ElmCommittee(ScaledBaseline):
    """Committee of extreme learning machines on standardised inputs and outputs."""

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
