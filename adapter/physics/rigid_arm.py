"""The rigid body part of a self model over tables of motion, by the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    base_at_rest,
    frames_of,
    regressors,
    torques,
    wrench_torques,
)


@dataclass(frozen=True, eq=False)
class RigidArm:
    """An arm on a base whose motion is known: what turns motion into torque.

    Of joints that slide q, dq, ddq are in m, m/s, m/s² and torque is a force in N.

    Attributes:
        frames: of its joints.
        gravity: (3,) acceleration of gravity in base axes, m/s².
        theta: (n, 10) inertial parameters, tool included.
        base: (m, 12) motion of the base, sample by sample; None where it rests.
    """

    frames: Frames
    gravity: Array
    theta: Array
    base: Array | None = None

    @classmethod
    def of(cls, model: SelfModel) -> RigidArm:
        """The rigid part of a self model with its tool."""
        theta = np.ascontiguousarray(model.theta_with_tool()[-model.tree.n :])
        return cls(frames_of(model.tree, model.lam), np.array(model.gravity), theta)

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.frames.parent)

    @property
    def slides(self) -> tuple[bool, ...]:
        """Of each joint whether it slides."""
        return tuple(self.frames.slides.tolist())

    def changed(self, theta: Array | None = None, gravity: Array | None = None) -> RigidArm:
        """The same arm with other inertias or another gravity."""
        theta = self.theta if theta is None else np.ascontiguousarray(theta)
        return replace(self, theta=theta, gravity=self.gravity if gravity is None else gravity)

    def moving(self, base: Array) -> RigidArm:
        """The same arm while its base moves, (m, 12); for tables of those m samples."""
        return replace(self, base=np.ascontiguousarray(base))

    def torque(self, q: Array, dq: Array, ddq: Array) -> Array:
        """tau (m, n), N m, for q, dq, ddq (m, n) rad, rad/s, rad/s²."""
        joints = _tables(q, dq, ddq)
        tau = np.empty_like(joints.q)
        base = base_at_rest(self.gravity)[None] if self.base is None else self.base
        torques(self.frames, self.theta, joints, base, tau)
        return tau

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y (m, n, 10 n): torque = Y @ theta.ravel()."""
        joints = _tables(q, dq, ddq)
        Y = np.empty((*joints.q.shape, 10 * self.n))
        regressors(self.frames, joints, base_at_rest(self.gravity)[None], Y)
        return Y

    def wrench_torque(self, q: Array, wrench: Array) -> Array:
        """Jᵀ wrench (m, n), N m: of a wrench [f; m] (6,), base axes, at the last link's origin."""
        out = np.empty((*q.shape, 1))
        column = np.array(wrench, dtype=np.float64).reshape(6, 1)
        wrench_torques(self.frames, np.ascontiguousarray(q), column, out)
        return out[:, :, 0]


def _tables(q: Array, dq: Array, ddq: Array) -> JointMotion:
    return JointMotion(*(np.ascontiguousarray(x) for x in (q, dq, ddq)))
