"""Twist synthesis: the links' motion from the documented kinematics, or as it was measured.

The paper's Panda has no sensors on its links; it computes their motion from the joint signals
and the documented λ. What is learned from that can only reproduce the documentation, and is
labelled so. Synthesized motion uses the same q and dq that the learner sees, so their noise
cancels. So does that of a floating base, whose links' motion is always synthesized: the base's has
passed the filter, and theirs would be of another instant. Measured motion is handed on unfiltered
beside the q and dq of its own stamp: the body-schema moments average its noise, and a low-pass
would shift products of fast signals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    base_at_rest,
    borrowed,
    frames_of,
    jit,
    link_motion,
)
from adapter.signals.records import KIND, LinkMotionKind, StateLayout, columns

Indices = NDArray[np.intp]

# No link of an arm moves faster: m/s, rad/s, m/s², rad/s².
MOTION_CAP = np.repeat([30.0, 60.0, 2e3, 2e4], 3)


class Raw(NamedTuple):
    """Samples as they came, behind a filter that makes several states of each.

    Attributes:
        rows: (m,) the state that is of the sample's own instant; states between it and that of
            the sample before are of instants at which no link was heard.
        q, dq: (m, n).
        links: twists and accels (m, n, 6), NaN where nothing was heard; None: of no link.
    """

    rows: Indices
    q: Array
    dq: Array
    links: tuple[Array, Array] | None


class TwistSynthesis:
    """Fills the link-motion part of a filtered state.

    Args:
        documented: whose λ and gravity the synthesized motion follows.
        imus: links carry sensors mounted anyhow, and what they read is handed on.
    """

    def __init__(self, documented: SelfModel, imus: bool = False) -> None:
        self._imus = imus
        self.layout = StateLayout(documented.tree.n, documented.tree.floating)
        # a plain tuple: numba takes 3 µs longer for a named one
        self._frames = tuple(frames_of(documented.tree, documented.lam))
        self._base = np.empty(0) if self.layout.floating else base_at_rest(documented.gravity)

    def fill(self, records: Array, raw: Raw) -> None:
        """Complete records (m, size) of these samples, whose q, dq, ddq are filled."""
        if self._imus:
            self._of_imus(records, raw)
            return
        if raw.links is None or self.layout.floating:
            synthesize(self._frames, self._base, records)
            return
        motion = np.concatenate(raw.links, axis=2)
        said = np.asarray(~np.isnan(motion).all(axis=(1, 2)))
        records[:, KIND] = LinkMotionKind.NONE
        self._measured(records, raw, said, motion)
        silent = ~said[np.searchsorted(raw.rows, np.arange(len(records)))]
        part = records[silent]
        synthesize(self._frames, self._base, part)
        records[silent] = part

    def _measured(self, records: Array, raw: Raw, said: NDArray[np.bool_], motion: Array) -> None:
        """Motion (m, n, 12) of samples whose links said something."""
        at, rows, motion = self.layout, raw.rows[said], motion[said]
        records[rows, at.motion_q], records[rows, at.motion_dq] = raw.q[said], raw.dq[said]
        records[rows, at.motion] = motion.reshape(len(rows), 12 * at.n)
        # a link that was not heard of at this stamp, or whose sensor is mad, leaves the body
        # schema a sample short
        usable = (np.abs(motion) < MOTION_CAP).all(axis=(1, 2))  # false for NaN
        records[rows, KIND] = np.where(usable, LinkMotionKind.MEASURED, LinkMotionKind.NONE)

    def _of_imus(self, records: Array, raw: Raw) -> None:
        at, rows = self.layout, raw.rows
        records[:, at.motion], records[:, KIND] = 0.0, LinkMotionKind.NONE
        records[rows, at.motion_q], records[rows, at.motion_dq] = raw.q, raw.dq
        records[rows, KIND] = LinkMotionKind.IMU
        if raw.links is None:
            return
        twists, accels = raw.links
        told = np.concatenate([twists[..., 3:], accels[..., :3]], axis=2)  # w and a
        heard = (np.abs(told) < MOTION_CAP[3:9]).all(axis=2)  # false for NaN
        motion = np.zeros((len(rows), at.n, 12))
        motion[..., 0], motion[..., 3:9] = heard, np.where(heard[..., None], told, 0.0)
        records[rows, at.motion] = motion.reshape(len(rows), 12 * at.n)


@jit
def synthesize(frames, base, records):
    """Fill the link motion of records (m, size) from their filtered q, dq, ddq.

    `base` is the motion (12,) of a base at rest; empty where the records hold the base's.
    """
    frames, base, records = borrowed((frames, base, records))
    arm = Frames(*frames)
    n = arm.parent.shape[0]
    at = columns(n, base.shape[0] == 0)
    for i in range(records.shape[0]):
        row = records[i]
        row[KIND] = LinkMotionKind.DOCUMENTED.value
        row[at.motion_q : at.motion] = row[at.q : at.ddq]
        joints = JointMotion(row[at.q : at.dq], row[at.dq : at.ddq], row[at.ddq : at.tau])
        moves = row[at.base : at.bent] if base.shape[0] == 0 else base
        link_motion(arm, joints, moves, row[at.motion :].reshape((n, 12)))
