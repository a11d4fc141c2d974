"""Axes without angles: where a joint's axis lies in two links whose frames may be any.

If joint s with axis u (in frame j) moves link j on body i, where the axis is u', then at every
instant dq_s = u·w_j - u'·w_i and ddq_s = u·dw_j - u'·dw_i. That is one linear regression with six
unknowns for each pair of bodies, the same for all joints. Its misfit is a lower bound on that of
the whole relation, and its u is where the search for the whole relation starts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.discovery.bodies import Bodies
from adapter.spatial import Array

SPEEDS = {"w": "dq", "dw": "ddq"}


class Axes(NamedTuple):
    """What the regression finds; the first index is the joint, then the link, then the body.

    Attributes:
        axis: (joints, links, bodies, 3) u in the link's frame, not normed.
        misfit: for each angular channel (joints, links, bodies) mean square of what is left.
    """

    axis: Array
    misfit: dict[str, Array]


def axes_of(bodies: Bodies, variance: dict[str, Array]) -> Axes:
    """Axes for every joint and pair of bodies.

    Args:
        bodies: links and the unseen base.
        variance: (links, joints, bodies) by channel; its median weighs the channels.
    """
    recorded = bodies.recorded
    m, n, links, count = len(recorded.q), recorded.q.shape[1], bodies.links, bodies.count
    first, second = np.divmod(np.arange(links * count), count)
    normal = np.tile(np.eye(6), (links * count, 1, 1))  # u and u' are about one long
    right = np.zeros((links * count, 6, n))
    parts: dict[str, tuple[Array, Array, Array]] = {}
    for k in (k for k in SPEEDS if k in bodies.channels):
        x, speed = bodies.motion[k].reshape(m, -1), getattr(recorded, SPEEDS[k])
        gram = (x.T @ x).reshape(count, 3, count, 3).transpose(0, 2, 1, 3)
        with_speed = (x.T @ speed).reshape(count, 3, n)
        block = np.empty((links * count, 6, 6))
        block[:, :3, :3], block[:, :3, 3:] = gram[first, first], -gram[first, second]
        block[:, 3:, :3], block[:, 3:, 3:] = -gram[second, first], gram[second, second]
        b = np.concatenate([with_speed[first], -with_speed[second]], axis=1)
        weight = 1.0 / (np.median(variance[k]) + 1e-30)
        normal += weight * block
        right += weight * b
        parts[k] = block, b, np.sum(speed**2, axis=0)
    found = np.linalg.solve(normal, right)
    misfit = {}
    for k, (block, b, power) in parts.items():
        left = power - 2.0 * np.sum(found * b, axis=1) + np.sum(found * (block @ found), axis=1)
        misfit[k] = np.maximum(left, 0.0).T.reshape(n, links, count) / m
    axis = found[:, :3].transpose(2, 0, 1).reshape(n, links, count, 3)
    return Axes(np.asarray(axis), misfit)
