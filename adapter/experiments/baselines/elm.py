"""A committee of extreme learning machines (Huang et al. 2006), the paper's second baseline.

A machine is a hidden layer of random tanh units that are never trained and output weights by
ridge regression. Each has its own units and its own random part of the samples; the committee's
answer is the mean. All in float64: with so weak a ridge the units' Gram matrix is not positive
definite in float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from adapter.errors import ModelError
from adapter.experiments.baselines.dense import gram, solve_positive
from adapter.experiments.baselines.learner import Progress, ScaledBaseline, Told
from adapter.model.spatial import Array

MEMBERS, UNITS, POINTS = 50, 4000, 10_000  # the paper's


@dataclass(frozen=True)
class _Machine:
    """One member: units tanh(x weights + biases), then the output weights."""

    weights: Array
    biases: Array
    output: Array

    def __call__(self, x: Array) -> Array:
        y: Array = np.tanh(x @ self.weights + self.biases) @ self.output
        return y


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
        self._machines: list[_Machine] = []

    def _learn_scaled(self, x: Array, y: Array, progress: Progress) -> Told:
        """Train every member on its own part. Raises ModelError for too weak a ridge."""
        self._machines = []
        points = min(self.points, len(x))
        for member in range(self.members):
            rng = np.random.default_rng([self.seed, member])
            rows = rng.choice(len(x), points, replace=False)
            self._machines.append(self._machine(x[rows], y[rows], rng))
            progress(f"committee: machine {member + 1} of {self.members}")
        return self._told(points, x.shape[1])

    def _machine(self, x: Array, y: Array, rng: np.random.Generator) -> _Machine:
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
        return _Machine(weights, biases, output)

    def _answer_scaled(self, x: Array) -> Array:
        """The mean over the committee."""
        mean: Array = np.asarray(sum(machine(x) for machine in self._machines)) / len(
            self._machines
        )
        return mean

    def _told(self, points: int, inputs: int) -> Told:
        sizes = {"members": self.members, "units": self.units, "points": points, "inputs": inputs}
        tuning = (
            f"Random input weights with deviation {self.spread:g} / sqrt({inputs}) on standardised "
            "inputs, biases uniform in -1 to 1.",
            f"Output weights by ridge regression, ridge {self.ridge:g} on the mean Gram matrix, "
            "float64 (float32 is not positive definite there).",
        )
        return sizes, tuning
