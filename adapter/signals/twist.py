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

import numpy as np

from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import Frames, JointMotion, base_at_rest, frames_of, jit, link_motion
from adapter.signals.records import KIND, LinkMotionKind, StateLayout, columns
from drivers.interface import JointSample

# No link of an arm moves faster: m/s, rad/s, m/s², rad/s².
MOTION_CAP = np.repeat([30.0, 60.0, 2e3, 2e4], 3)


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
        self._frames = tuple(frames_of(documented.tree.parent, documented.lam))
        self._base = np.empty(0) if self.layout.floating else base_at_rest(documented.gravity)

    def fill(self, record: Array, sample: JointSample) -> None:
        """Complete a record whose q, dq, ddq are filled, for the sample that led to it."""
        links = sample.links
        if self._imus:
            told = None if links is None else (links.twist[None], links.accel[None])
            self._of_imus(record[None], sample.q[None], sample.dq[None], told)
        elif links is None or self.layout.floating:
            synthesize(self._frames, self._base, record[None])
        else:
            self._measured(
                record[None], sample.q[None], sample.dq[None], links.twist[None], links.accel[None]
            )

    def fill_table(
        self, records: Array, q: Array, dq: Array, links: tuple[Array, Array] | None
    ) -> None:
        """Complete records (m, size); raw q, dq (m, n), twists and accels (m, n, 6) beside them."""
        if self._imus:
            self._of_imus(records, q, dq, links)
            return
        if links is None or self.layout.floating:
            synthesize(self._frames, self._base, records)
            return
        twists, accels = links
        heard = ~np.isnan(twists).all(axis=(1, 2)) | ~np.isnan(accels).all(axis=(1, 2))
        part = records[heard]
        self._measured(part, q[heard], dq[heard], twists[heard], accels[heard])
        records[heard] = part
        part = records[~heard]
        synthesize(self._frames, self._base, part)
        records[~heard] = part

    def _measured(self, records: Array, q: Array, dq: Array, twists: Array, accels: Array) -> None:
        at = self.layout
        records[:, at.motion_q], records[:, at.motion_dq] = q, dq
        motion = np.concatenate([twists, accels], axis=2)
        records[:, at.motion] = motion.reshape(len(records), 12 * at.n)
        # a link that was not heard of at this stamp, or whose sensor is mad, leaves the body
        # schema a sample short
        usable = (np.abs(motion) < MOTION_CAP).all(axis=(1, 2))  # false for NaN
        records[:, KIND] = np.where(usable, LinkMotionKind.MEASURED, LinkMotionKind.NONE)

    def _of_imus(
        self, records: Array, q: Array, dq: Array, links: tuple[Array, Array] | None
    ) -> None:
        at = self.layout
        records[:, at.motion_q], records[:, at.motion_dq] = q, dq
        records[:, at.motion], records[:, KIND] = 0.0, LinkMotionKind.IMU
        if links is None:
            return
        told = np.concatenate([links[0][..., 3:], links[1][..., :3]], axis=2)  # w and a
        heard = (np.abs(told) < MOTION_CAP[3:9]).all(axis=2)  # false for NaN
        rows = records[:, at.motion].reshape(len(records), at.n, 12)
        rows[..., 0], rows[..., 3:9] = heard, np.where(heard[..., None], told, 0.0)
        records[:, at.motion] = rows.reshape(len(records), 12 * at.n)


@jit
def synthesize(frames, base, records):
    """Fill the link motion of records (m, size) from their filtered q, dq, ddq.

    `base` is the motion (12,) of a base at rest; empty where the records hold the base's.
    """
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
