"""What passes between the front end and the learner: one flat record per sample, a filtered state.

Flat, because the same bytes travel through shared memory in the live process and through a
plain call in replay and tests.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.by_joint import WAYS_RAD, JointSignals
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

STAMP, KIND = 0, 1  # the first two columns of every state


class LinkMotionKind(IntEnum):
    """Where the link motion of a state comes from.

    Of sensors mounted anyhow (IMU) a link's row is [heard 0 0, w, a, 0 0 0] in the sensor's axes,
    heard being 1 where the sensor said something at that stamp; all else is then zero.
    """

    NONE = 0
    DOCUMENTED = 1
    MEASURED = 2
    IMU = 3


class StateColumns(NamedTuple):
    """First column of each signal of a state, and how many columns there are; see `columns`."""

    q: int
    dq: int
    ddq: int
    tau: int
    base: int
    bent: int
    rates: int
    motion_q: int
    motion_dq: int
    motion: int
    size: int


@jit
def columns(n, floating):
    """Where each signal of a filtered state begins; compiled code and `StateLayout` ask here.

    Behind the stamp and the kind of link motion come, all of the filtered instant: q, dq, ddq
    (n each), tau (n, or 6 + n with the wrench on a floating base first), of a floating base alone
    its motion (12), how far bristles are bent (K n, see `bristles`) and rates of the model's torque
    (2 n, which the learner fills in). Then what the body schema learns from, all of one instant of
    its own: q, dq (n each) and the links' motion (n, 12). A motion is [v, w, a, dw].
    """
    tau = 2 + 3 * n
    base = tau + n + (6 if floating else 0)
    bent = base + (12 if floating else 0)
    rates = bent + len(WAYS_RAD) * n
    motion_q = rates + 2 * n
    motion = motion_q + 2 * n
    return StateColumns(
        2, 2 + n, 2 + 2 * n, tau, base, bent, rates, motion_q, motion_q + n, motion, motion + 12 * n
    )


class StateLayout:
    """Where each signal of a filtered state sits in its record of `size` float64.

    Args:
        n: joints.
        floating: whether the base moves; then its motion is part of the state.

    Attributes:
        q, dq, ddq, tau, base, bent, rates, motion_q, motion_dq, motion: slices, as `columns` has
            them; `base` is empty where the base does not float.
        memory: `bent` and `rates`, what a column with a memory is made of.
        joint_tau: the joints' torques, behind the wrench on a floating base.
        before_links: all columns before what the body schema learns from.
    """

    def __init__(self, n: int, floating: bool = False) -> None:
        self.n, self.floating = n, floating
        at = columns(n, floating)
        self.size = at.size
        parts = [slice(at[k], at[k + 1]) for k in range(9)]
        self.q, self.dq, self.ddq, self.tau, self.base = parts[:5]
        self.bent, self.rates, self.motion_q, self.motion_dq = parts[5:]
        self.memory = slice(at.bent, at.motion_q)
        self.motion = slice(at.motion, at.size)
        self.joint_tau = slice(at.base - n, at.base)
        self.before_links = slice(0, at.motion_q)

    def signals(self, table: Array, smoothing_s: float = 0.0) -> JointSignals:
        """What the torques of states (m, size), or of their columns `before_links`, depend on."""
        m, n = len(table), self.n
        bent = table[:, self.bent].reshape(m, -1, n).swapaxes(0, 1)
        rates = table[:, self.rates].reshape(m, 2, n).swapaxes(0, 1)
        q, dq, ddq, tau = (table[:, x] for x in (self.q, self.dq, self.ddq, self.joint_tau))
        return JointSignals(q, dq, ddq, tau, smoothing_s, bent, rates)

    def new(self, rows: int | None = None) -> Array:
        """An empty record, or a table of them."""
        return np.zeros(self.size if rows is None else (rows, self.size))


def stamp_of(record: Array) -> int:
    """The stamp of the filtered instant, ns."""
    return int(record[:1].view(np.int64)[0])


def stamps_of(table: Array) -> NDArray[np.int64]:
    """Stamps (m,) of a table of records, ns."""
    return np.ascontiguousarray(table[:, STAMP]).view(np.int64)
