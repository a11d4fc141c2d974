"""What passes between the front end and the learner: one flat record per sample.

Flat, because the same bytes travel through shared memory in the live process and through a
plain call in replay and tests.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOTION_NONE, MOTION_DOCUMENTED, MOTION_MEASURED = 0, 1, 2


class StateLayout:
    """Where each signal of a filtered state sits in its record of `size` float64.

    For n joints: the stamp (int64 bits, ns), the kind of link motion, then q, dq, ddq, tau
    (n each) of the filtered instant, then what the body schema learns from, all of one instant
    of its own: q, dq (n each) and the links' motion (n, 12) = [v, w, a, dw].
    """

    def __init__(self, n: int) -> None:
        self.n = n
        self.size = 2 + 18 * n
        o = 2
        self.q, self.dq, self.ddq, self.tau, self.motion_q, self.motion_dq = (
            slice(o + k * n, o + (k + 1) * n) for k in range(6)
        )
        self.motion = slice(o + 6 * n, self.size)

    def new(self, rows: int | None = None) -> Array:
        """An empty record, or a table of them."""
        return np.zeros(self.size if rows is None else (rows, self.size))


def stamp_of(record: Array) -> int:
    """The stamp of the filtered instant, ns."""
    return int(record[:1].view(np.int64)[0])


def stamps_of(table: Array) -> NDArray[np.int64]:
    """Stamps (m,) of a table of records, ns."""
    return np.ascontiguousarray(table[:, 0]).view(np.int64)
