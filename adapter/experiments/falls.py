"""Simulated falls as samples for learners, one trajectory at a time.

They are split as the paper does: shuffled train and test samples, and a control set.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning.batch.smoothing import smoothed_data
from adapter.learning.tree_data import BodyMotion, TreeData, stacked
from adapter.model.tree import Tree
from sim.falls.data_set import FallData

# Section IV.A: 63 trajectories, 50 of them for training and test, the other 13 as control set.
PAPER_TRAJECTORIES, PAPER_TRAINED = 63, 50
TRAIN_SHARE = 0.75  # the paper's 75/25, read as 75 % train (reading notes)
LEARN_SHARE = 0.01  # of the training set, all that the FOP networks are given
LEAST_TRAJECTORIES = 5  # four to learn from and one as control set
SETS = ("train", "test", "control")


@dataclass(frozen=True)
class Split:
    """Which samples of which trajectory belong to which set.

    Attributes:
        lengths: samples of each trajectory of the train-and-test part.
        control: numbers of the control trajectories.
        train, test: rows in the trajectories of that part, one after the other; shuffled.
    """

    lengths: tuple[int, ...]
    control: tuple[int, ...]
    train: np.ndarray
    test: np.ndarray

    @property
    def learned(self) -> np.ndarray:
        """The rows that λ and θ are learned from."""
        return self.train[: round(LEARN_SHARE * len(self.train))]

    def rows_in(self, rows: np.ndarray, k: int) -> np.ndarray:
        """Those of the given rows that lie in trajectory k, counted from its start, in order."""
        start = sum(self.lengths[:k])
        return np.sort(rows[(rows >= start) & (rows < start + self.lengths[k])]) - start


def _used(count: int) -> int:
    """Trajectories for training and test of so many."""
    return round(count * PAPER_TRAINED / PAPER_TRAJECTORIES)


def learned_samples(count: int, length: int) -> int:
    """How many samples λ and θ are learned from, of `count` trajectories of `length` samples."""
    return round(LEARN_SHARE * round(TRAIN_SHARE * _used(count) * length))


def split(lengths: list[int], seed: int) -> Split:
    """Split trajectories of these lengths: about four fifths train and test, as the paper.

    Raises:
        ModelError: fewer than 5 trajectories.
    """
    count = len(lengths)
    if count < LEAST_TRAJECTORIES:
        raise ModelError(
            f"the experiment needs at least {LEAST_TRAJECTORIES} trajectories, got {count}"
        )
    used = _used(count)
    order = np.random.default_rng(seed).permutation(sum(lengths[:used]))
    cut = round(TRAIN_SHARE * len(order))
    control = tuple(range(used, count))
    return Split(tuple(lengths[:used]), control, order[:cut], order[cut:])


class Falls:
    """Simulated trajectories as samples for learners."""

    def __init__(self, exact: FallData, noisy: FallData) -> None:
        self._exact, self.noisy = exact, noisy
        self.truth = truth = exact.truth
        self.tree = Tree(truth.parent, True, truth.joint_names, truth.link_names, truth.base_name)

    def __len__(self) -> int:
        return len(self._exact)

    def exact(self, k: int) -> TreeData:
        """Trajectory k without noise."""
        record = self._exact.exact(k)
        v, w, a, dw = record.links(self.truth)
        free = np.zeros((len(record.q), 6))  # nothing pushes a falling base
        return TreeData(
            self.tree,
            record.q,
            record.dq,
            record.ddq,
            np.hstack([free, record.tau]),
            BodyMotion(record.base_w, record.base_a, record.base_dw, record.base_v),
            BodyMotion(w, a, dw, v),
        )

    def measured(self, k: int) -> TreeData:
        """Trajectory k as its sensors show it, filtered alike."""
        return smoothed_data(self.tree, self.noisy[k])


def gathered(source: Falls, parts: Split, rows: np.ndarray, noisy: bool) -> TreeData:
    """Samples at these rows of the train-and-test part."""
    found = []
    for k in range(len(parts.lengths)):
        own = parts.rows_in(rows, k)
        if len(own):
            data = source.measured(k) if noisy else source.exact(k)
            found.append(data.take(own))
    return stacked(found)


def sets_of(source: Falls, parts: Split) -> Iterator[tuple[TreeData, dict[str, np.ndarray]]]:
    """Every trajectory without noise, with its rows by set."""
    for k in range(len(source)):
        data = source.exact(k)
        if k in parts.control:
            yield data, {"control": np.arange(len(data))}
        else:
            rows = {"train": parts.rows_in(parts.train, k), "test": parts.rows_in(parts.test, k)}
            yield data, rows
