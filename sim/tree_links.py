"""What sensors at the link frames of a tree would read: the simulator's own formulas.

Each link is handled by itself: its motion relative to its parent is that of a body on a turning
platform. In the axes of the child the platform's w and dw are W and W', and a turn by q about z
adds [0 0 dq] to the one and [0 0 ddq] + W x [0 0 dq] to the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.tree_truth import BASE, TreeTruth
from sim.truth import Array


@dataclass(frozen=True, eq=False)
class LinkTables:
    """Motion of n links over m samples, (m, n, 3) each, every link in its own frame.

    Attributes:
        v: velocity of the frame's origin, m/s.
        w: angular velocity, rad/s.
        a: acceleration of the origin minus gravity (what an accelerometer reads), m/s².
        dw: angular acceleration, rad/s².
    """

    v: Array
    w: Array
    a: Array
    dw: Array


def link_tables(
    truth: TreeTruth, q: Array, dq: Array, ddq: Array, base: tuple[Array, Array, Array, Array]
) -> LinkTables:
    """Motion of all moving links.

    Args:
        truth: of the tree; its frames are used.
        q: (m, n) rad.
        dq: (m, n) rad/s.
        ddq: (m, n) rad/s².
        base: v, w, a, dw of the base, (m, 3) each, units and frames as in `LinkTables`.
    """
    found: list[tuple[Array, Array, Array, Array]] = []
    for j, i in enumerate(truth.parent):
        v, w, a, dw = base if i == BASE else found[i]
        p = truth.p[j]
        swing = np.cross(w, p)
        at_joint = (v + swing, w, a + np.cross(dw, p) + np.cross(w, swing), dw)
        v, w, a, dw = (_turned_back(truth.R[j], q[:, j], x) for x in at_joint)
        spin, w_rest = dq[:, j], w.copy()
        w[:, 2] += spin
        dw[:, 0] += w_rest[:, 1] * spin
        dw[:, 1] -= w_rest[:, 0] * spin
        dw[:, 2] += ddq[:, j]
        found.append((v, w, a, dw))
    return LinkTables(*(np.stack(part, axis=1) for part in zip(*found, strict=True)))


def _turned_back(R: Array, q: Array, x: Array) -> Array:
    """Vectors x (m, 3) of the parent's axes in those of a joint R turned by q (m,)."""
    x = x @ R
    c, s = np.cos(q), np.sin(q)
    return np.stack([c * x[:, 0] + s * x[:, 1], c * x[:, 1] - s * x[:, 0], x[:, 2]], axis=1)
