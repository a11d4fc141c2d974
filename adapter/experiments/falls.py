"""Simulated falls as samples for learners, one trajectory at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from adapter.experiments.split import Split
from adapter.learning.batch.smoothing import smoothed_data
from adapter.learning.tree_data import BodyMotion, TreeData, stacked
from adapter.model.tree import Tree
from sim.falls.data_set import FallData


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
        links = record.links(self.truth)
        free = np.zeros((len(record.q), 6))  # nothing pushes a falling base
        return TreeData(
            self.tree,
            record.q,
            record.dq,
            record.ddq,
            np.hstack([free, record.tau]),
            BodyMotion(record.base_w, record.base_a, record.base_dw, record.base_v),
            BodyMotion(links.w, links.a, links.dw, links.v),
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
