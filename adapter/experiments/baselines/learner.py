"""What all baselines have in common: fit, predict, facts; scaled inputs and outputs; algebra.

Large matrices are in float64: on a GPU where there is one, else by numpy and scipy, whose products
on a CPU are about twice as fast as torch's.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg

from adapter.errors import ModelError
from adapter.model.spatial import Array

# Told a sentence now and then while a learner works.
Progress = Callable[[str], None]
# Sizes by name, and sentences on the tuning, of a learner that has learned.
Told = tuple[Mapping[str, float], tuple[str, ...]]


@dataclass(frozen=True)
class Facts:
    """What is to be said of a trained learner.

    Attributes:
        sizes: numbers of units, samples, members, ...
        tuning: sentences: what was chosen, and how.
        train_s: seconds that `fit` took.
    """

    sizes: dict[str, float]
    tuning: tuple[str, ...]
    train_s: float


class Baseline(ABC):
    """A learner of Y (m, n), N m, from X (m, width) in the layout of `features.Columns`.

    Attributes:
        at_once: samples that are predicted together.
    """

    at_once = 10_000
    _facts: Facts | None = None

    def fit(self, X: Array, Y: Array, progress: Progress | None = None) -> None:
        """Learn from samples. Raises ModelError for tables that don't fit or aren't finite."""
        begin = time.perf_counter()
        X = checked(X, Y)
        sizes, tuning = self._learn(X, Y, progress or (lambda said: None))
        self._width = X.shape[1]
        named = {name: float(value) for name, value in sizes.items()}
        self._facts = Facts(named, tuning, time.perf_counter() - begin)

    def predict(self, X: Array) -> Array:
        """Torques (m, n), N m. Raises ModelError before `fit` or for another width."""
        self.facts()
        x = checked(X, width=self._width)
        starts = range(0, len(x), self.at_once)
        return np.concatenate([self._answer(x[k : k + self.at_once]) for k in starts])

    def facts(self) -> Facts:
        """Sizes, tuning and training time. Raises ModelError before `fit`."""
        if self._facts is None:
            raise ModelError("this learner has not learned yet; call fit first")
        return self._facts

    @abstractmethod
    def _learn(self, X: Array, Y: Array, progress: Progress) -> Told:
        """Learn from checked samples. Returns sizes by name, and sentences on the tuning."""

    @abstractmethod
    def _answer(self, x: Array) -> Array:
        """Torques (m, n), N m, of at most `at_once` checked samples."""


class ScaledBaseline(Baseline):
    """A learner of inputs and outputs at zero mean and unit deviation."""

    def _learn(self, X: Array, Y: Array, progress: Progress) -> Told:
        self._in, self._out = Scale.of(X), Scale.of(Y)
        return self._learn_scaled(self._in(X), self._out(Y), progress)

    def _answer(self, x: Array) -> Array:
        return self._out.undo(self._answer_scaled(self._in(x)))

    @abstractmethod
    def _learn_scaled(self, x: Array, y: Array, progress: Progress) -> Told:
        """`_learn` from scaled samples."""

    @abstractmethod
    def _answer_scaled(self, x: Array) -> Array:
        """`_answer` to scaled samples, itself scaled."""


@dataclass(frozen=True)
class Scale:
    """Columns brought to zero mean and unit deviation; constant ones only to zero mean.

    Attributes:
        mean, deviation: (width,) of the table that it was made from.
    """

    mean: Array
    deviation: Array

    @classmethod
    def of(cls, table: Array) -> Scale:
        """Of a table (m, width)."""
        mean, deviation = table.mean(axis=0), table.std(axis=0)
        flat = deviation <= 1e-12 * np.abs(table).max(axis=0)  # a constant and rounding
        return cls(mean, np.where(flat, 1.0, deviation))

    def __call__(self, table: Array) -> Array:
        """The table scaled."""
        scaled: Array = (table - self.mean) / self.deviation
        return scaled

    def undo(self, scaled: Array) -> Array:
        """A scaled table in its own units, in float64."""
        table: Array = scaled * self.deviation + self.mean
        return table


def checked(X: Array, Y: Array | None = None, width: int | None = None) -> Array:
    """X as float64 (m, width). Raises ModelError where X or Y won't do for learning."""
    x = np.asarray(X, dtype=np.float64)
    if x.ndim != 2 or not len(x) or (width is not None and x.shape[1] != width):
        wanted = "columns" if width is None else f"{width} columns"
        raise ModelError(f"X must be a table of samples by {wanted}, got shape {x.shape}")
    if not np.isfinite(x).all():
        raise ModelError("X holds values that are not finite; leave those samples out")
    if Y is not None:
        if np.ndim(Y) != 2 or len(Y) != len(x):
            raise ModelError(f"Y must have {len(x)} rows, one by sample, got shape {np.shape(Y)}")
        if not np.isfinite(Y).all():
            raise ModelError("Y holds values that are not finite; leave those samples out")
    return x


def accelerator() -> torch.device | None:
    """The GPU; None where there is none."""
    return torch.device("cuda") if torch.cuda.is_available() else None


def gram(table: Array) -> Array:
    """Tᵀ T of a table T (m, k)."""
    place = accelerator()
    if place is None:
        return np.asarray(table.T @ table)
    there = torch.from_numpy(table).to(place)
    return np.asarray((there.T @ there).cpu().numpy())


def solve_positive(matrix: Array, right: Array) -> Array:
    """A⁻¹ B by Cholesky, A (k, k) positive definite and overwritten, B (k, outputs).

    Raises:
        LinAlgError: A is not positive definite in float64.
    """
    place = accelerator()
    if place is None:
        factor = linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        return np.asarray(linalg.cho_solve(factor, right, check_finite=False))
    lower, trouble = torch.linalg.cholesky_ex(torch.from_numpy(matrix).to(place))
    if int(trouble):
        raise linalg.LinAlgError("the matrix is not positive definite")
    there = torch.from_numpy(np.ascontiguousarray(right)).to(place)
    return np.asarray(torch.cholesky_solve(there, lower).cpu().numpy())
