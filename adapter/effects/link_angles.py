"""How links move where encoders and gears stand between them and what is read: compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.effects.by_joint import ByJoint
from adapter.model.spatial import Array
from adapter.physics.kernels import JointMotion, jit


class JointTorques(NamedTuple):
    """Torques of joints and their rates, each (n,): N m, N m/s, N m/s². They twist the gears."""

    tau: Array
    dtau: Array
    ddtau: Array


class Gears(NamedTuple):
    """What encoders and gears add to the angles of n joints, each (n,); see `ByJoint`."""

    offset: Array
    ripple: Array
    phase: Array
    compliance: Array

    @classmethod
    def of(cls, effects: ByJoint) -> Gears:
        """Those among effects."""
        return cls(effects.offset, effects.ripple, effects.phase, effects.compliance)


@jit
def to_links(motion: JointMotion, torques: JointTorques, gears: Gears) -> None:
    """Turn a motion (n,) that encoders say into that of the links, in place."""
    q, dq, ddq = motion
    for j in range(q.shape[0]):
        twist = gears.compliance[j]
        sine = gears.ripple[j] * np.sin(q[j] + gears.phase[j])
        cosine = gears.ripple[j] * np.cos(q[j] + gears.phase[j])
        v = dq[j]
        q[j] -= gears.offset[j] + sine + twist * torques.tau[j]
        dq[j] -= cosine * v + twist * torques.dtau[j]
        ddq[j] -= cosine * ddq[j] - sine * v * v + twist * torques.ddtau[j]
