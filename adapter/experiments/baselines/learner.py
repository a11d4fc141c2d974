"""What all baselines have in common: fit, predict; inputs and outputs, scaled; algebra.

Large matrices are in float64: on a GPU where there is one, else by numpy and scipy, whose products
on a CPU are about twice as fast as torch's.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg

from adapter.errors import ModelError
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree

# Told a sentence now and then while a learner works.
Progress = Callable[[str], None]
# Sizes by name, and sentences on the tuning, of a learner that has learned.
Told = tuple[Mapping[str, float], tuple[str, ...]]


class Baseline(ABC):
    """A learner of Y (m, n), N m, from X (m, width) in the layout of `Columns`.

    Attributes:
        at_once: samples that are predicted together.
        sizes: numbers of units, samples, members, ...; empty before `fit`.
        tuning: sentences: what was chosen, and how.
        train_s: seconds that `fit` took.
    """

    at_once = 10_000
    sizes: Mapping[str, float] = {}
    tuning: tuple[str, ...] = ()
    train_s = 0.0

    def fit(self, X: Array, Y: Array, progress: Progress | None = None) -> None:
        """Learn from samples. Raises ModelError for tables that don't fit or aren't finite."""
        begin = time.perf_counter()
        X = checked(X, Y)
        sizes, self.tuning = self._learn(X, Y, progress or (lambda said: None))
        self._width = X.shape[1]
        self.sizes = {name: float(value) for name, value in sizes.items()}
        self.train_s = time.perf_counter() - begin

    def predict(self, X: Array) -> Array:
        """Torques (m, n), N m. Raises ModelError before `fit` or for another width."""
        if not self.sizes:
            raise ModelError("this learner has not learned yet; call fit first")
        x = checked(X, width=self._width)
        starts = range(0, len(x), self.at_once)
        return np.concatenate([self._answer(x[k : k + self.at_once]) for k in starts])

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


@dataclass(frozen=True)
class Columns:
    """Which column of X is what: q, dq, ddq (n each), then w, a, dw of the carrier (3 each).

    The torques of a sub-chain of a tree are a function of its own q, dq, ddq and of the motion of
    the link that carries it: its angular velocity and its acceleration with gravity. So the task is
    well-posed, whatever the rest of the robot does. They do not depend on the linear velocity v of
    that link (Galilei): v is in the paper's list of inputs (twist), but would only add three
    columns of nuisance; in free fall it says how long the fall has lasted.

    Attributes:
        n: number of joints of the sub-chain.
    """

    n: int

    @property
    def width(self) -> int:
        """Number of columns of X."""
        return 3 * self.n + 9

    def check(self, x: Array, y: Array) -> None:
        """Raises ModelError where X has other columns, or Y not one by joint."""
        checked(x, width=self.width)
        if y.shape[1] != self.n:
            raise ModelError(f"Y must have {self.n} columns, got {y.shape[1]}")

    def joints(self, x: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) of X."""
        n = self.n
        return x[:, :n], x[:, n : 2 * n], x[:, 2 * n : 3 * n]

    def carrier(self, x: Array) -> BodyMotion:
        """Motion (m, 3) of the link that carries the sub-chain."""
        w, a, dw = (x[:, 3 * self.n + 3 * k : 3 * self.n + 3 * k + 3] for k in range(3))
        return BodyMotion(w, a, dw)


def arm_problem(data: TreeData, joints: Sequence[str], carrier: str) -> tuple[Array, Array]:
    """Inputs X (m, width, see `Columns`) and torques Y (m, joints) of a sub-chain.

    Args:
        data: samples of the whole tree, with measured motion of the links.
        joints: names of the sub-chain's joints, from the carrier outwards; with everything that
            hangs on them, or the torques would depend on what X does not hold.
        carrier: name of the link (or base) that carries them; its motion is in its own frame.

    Raises:
        ModelError: joints that are no such sub-chain of that carrier, or samples that are not
            finite.
    """
    index = sub_chain(data.tree, joints, carrier)
    link, links = data.tree.parent[index[0]], data.links
    motion = [data.base.w, data.base.a, data.base.dw]
    if link != BASE:
        assert links is not None
        motion = [links.w[:, link], links.a[:, link], links.dw[:, link]]
    first = data.tree.rows - data.tree.n
    x = np.concatenate([data.q[:, index], data.dq[:, index], data.ddq[:, index], *motion], axis=1)
    y = data.tau[:, first + index]
    return checked(x, y), y


def sub_chain(tree: Tree, joints: Sequence[str], carrier: str) -> np.ndarray:
    """Indices (n,) of the joints, checked to be all that hangs on the first. See `arm_problem`."""
    index = [tree.joint_index(name) for name in joints]
    if not index:
        raise ModelError(f"no joints named; have: {', '.join(tree.joint_names)}")
    bodies = (tree.base_name, *tree.link_names)
    on = bodies[tree.parent[index[0]] + 1]
    if carrier != on:
        raise ModelError(f"joint '{joints[0]}' hangs on link '{on}', not on '{carrier}'")
    inside = [j for j in range(tree.n) if index[0] in tree.path_to(j)]
    if sorted(index) != inside or any(
        tree.parent[j] not in index[:k] for k, j in enumerate(index) if k
    ):
        needed = ", ".join(tree.joint_names[j] for j in inside)
        raise ModelError(
            f"the joints must be joint '{joints[0]}' and all that hangs on it, parents first: "
            f"{needed}"
        )
    return np.array(index)


def sub_parents(tree: Tree, index: np.ndarray) -> tuple[int, ...]:
    """Parents of a sub-chain's joints as a tree of its own, the carrier as its base."""
    place = {int(j): k for k, j in enumerate(index)}
    return tuple(place.get(tree.parent[int(j)], BASE) for j in index)
