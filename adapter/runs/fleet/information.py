"""What moments tell of (θ, effects): one linear map for recordings by the thousand."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array

from adapter.learning.theta import Theta
from adapter.model.spatial import Array


class Information:
    """Information of the joints' torques, with the weights and shapes of effects as they are now.

    `Theta.data_information` for one set of moments after the other: what it looks up is looked up
    once here, which makes it a hundred times faster.

    Args:
        theta: whose parameters and weights these are.
    """

    def __init__(self, theta: Theta) -> None:
        self._width = theta.P + 1  # the torque is the last column
        at, weights = theta.rows, theta.weights()
        parts = []
        for j, size in enumerate(at.sizes):
            place, share = np.r_[at.place[j, :size], theta.P], np.r_[at.share[j, :size], 1.0]
            first, second = np.triu_indices(size + 1)
            value = weights[j] * share[first] * share[second]
            number = at.starts[j] + np.arange(len(first))
            mirrored = first != second
            for a, b, use in ((first, second, slice(None)), (second, first, mirrored)):
                to = place[a] * self._width + place[b]
                parts.append((value[use], to[use], number[use]))
        value, to, number = (np.concatenate(x) for x in zip(*parts, strict=True))
        shape = self._width**2, len(theta.moments.A)
        self._map: csr_array = coo_array((value, (to, number)), shape=shape).tocsr()

    def __call__(self, A: Array) -> tuple[Array, Array]:
        """Information (P, P) and right side (P,) of moments A, see `Moments`."""
        whole = np.asarray(self._map @ A).reshape(self._width, self._width)
        return whole[:-1, :-1], whole[:-1, -1]
