"""What ideal sensors at the link frames of a tree would read, over a whole table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.compiled import compiled
from sim.dynamics import Frames, link_motion
from sim.falls.tree_truth import TreeTruth
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
    frames = Frames(np.array(truth.parent), truth.R, truth.p)
    return LinkTables(*_tables(frames, np.stack(base, axis=1), q, dq, ddq).transpose(2, 0, 1, 3))


@compiled
def _tables(frames: Frames, base: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """(m, n, 4, 3) link motion for tables (m, n) and base (m, 4, 3)."""
    out = np.empty((*q.shape, 4, 3))
    for k in range(len(q)):
        out[k] = link_motion(frames, base[k], q[k], dq[k], ddq[k])
    return out
