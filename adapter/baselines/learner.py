"""What all baselines have in common: fit, predict, facts; scaled inputs and outputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adapter.errors import ModelError
from adapter.spatial import Array

# Told a sentence now and then while a learner works.
Progress = Callable[[str], None]

# A column whose deviation is below this share of its size holds a constant and rounding.
CONSTANT_SHARE = 1e-12


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


class Baseline(Protocol):
    """A learner of Y (m, n), N m, from X (m, width) in the layout of `features.Columns`."""

    def fit(self, X: Array, Y: Array, progress: Progress | None = None) -> None:
        """Learn from samples. Raises ModelError for tables that don't fit or aren't finite."""
        ...

    def predict(self, X: Array) -> Array:
        """Torques (m, n), N m. Raises ModelError before `fit` or for another width."""
        ...

    def facts(self) -> Facts:
        """Sizes, tuning and training time. Raises ModelError before `fit`."""
        ...


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
        flat = deviation <= CONSTANT_SHARE * np.abs(table).max(axis=0)
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


def at_least(least: int, **counts: int) -> None:
    """Raises ModelError naming the count that is too small."""
    for name, value in counts.items():
        if value < least:
            raise ModelError(f"{name} must be at least {least}, got {value}")


def positive(**numbers: float) -> None:
    """Raises ModelError naming the number that is not positive and finite."""
    for name, value in numbers.items():
        if not 0.0 < value < np.inf:
            raise ModelError(f"{name} must be positive and finite, got {value}")


def unfitted() -> ModelError:
    """The error of a learner that is asked before it has learned."""
    return ModelError("this learner has not learned yet; call fit first")
