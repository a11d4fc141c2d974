"""The rigid body part of a self model over tables of motion, by the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adapter.fast import jit, link_motion, regressor
from adapter.model import SelfModel
from adapter.records import Array
from adapter.spatial import matrix_from_zxz
from adapter.twist import base_motion


@jit
def rigid_torque(parent, R0, p, base, theta, q, dq, ddq, tau):
    """tau (m, n) = Y theta over tables q, dq, ddq (m, n), by Newton and Euler (eqs. 11 to 16)."""
    n = parent.shape[0]
    motion, wrench = np.empty((n, 12)), np.empty((n, 6))
    for m in range(q.shape[0]):
        link_motion(parent, R0, p, q[m], dq[m], ddq[m], base, motion)
        for j in range(n):
            body_wrench(motion[j], theta[10 * j : 10 * j + 10], wrench[j])
        for j in range(n - 1, -1, -1):
            tau[m, j] = wrench[j, 5]
            if parent[j] >= 0:
                add_to_parent(R0[j], p[j], q[m, j], wrench[j], wrench[parent[j]])


@jit
def body_wrench(m, t, out):
    """Wrench [f; n] (6,) of one body (eqs. 11, 12): motion row m (12,), parameters t (10,)."""
    wx, wy, wz = m[3], m[4], m[5]
    ax, ay, az = m[6], m[7], m[8]
    ex, ey, ez = m[9], m[10], m[11]
    mass, hx, hy, hz = t[0], t[1], t[2], t[3]
    # angular momentum's axis terms: I w and I dw about the origin
    lx = t[4] * wx + t[5] * wy + t[6] * wz
    ly = t[5] * wx + t[7] * wy + t[8] * wz
    lz = t[6] * wx + t[8] * wy + t[9] * wz
    wh = wx * hx + wy * hy + wz * hz
    ww = wx * wx + wy * wy + wz * wz
    out[0] = mass * ax + ey * hz - ez * hy + wx * wh - ww * hx
    out[1] = mass * ay + ez * hx - ex * hz + wy * wh - ww * hy
    out[2] = mass * az + ex * hy - ey * hx + wz * wh - ww * hz
    out[3] = t[4] * ex + t[5] * ey + t[6] * ez + wy * lz - wz * ly + hy * az - hz * ay
    out[4] = t[5] * ex + t[7] * ey + t[8] * ez + wz * lx - wx * lz + hz * ax - hx * az
    out[5] = t[6] * ex + t[8] * ey + t[9] * ez + wx * ly - wy * lx + hx * ay - hy * ax


@jit
def add_to_parent(R, P, angle, w, out):
    """Add a wrench w (6,) of link j to `out` (6,), expressed at and in its parent (eq. 14a)."""
    c, s = np.cos(angle), np.sin(angle)
    f0, f1, f2 = c * w[0] - s * w[1], s * w[0] + c * w[1], w[2]
    n0, n1, n2 = c * w[3] - s * w[4], s * w[3] + c * w[4], w[5]
    fx = R[0, 0] * f0 + R[0, 1] * f1 + R[0, 2] * f2
    fy = R[1, 0] * f0 + R[1, 1] * f1 + R[1, 2] * f2
    fz = R[2, 0] * f0 + R[2, 1] * f1 + R[2, 2] * f2
    out[0] += fx
    out[1] += fy
    out[2] += fz
    out[3] += R[0, 0] * n0 + R[0, 1] * n1 + R[0, 2] * n2 + P[1] * fz - P[2] * fy
    out[4] += R[1, 0] * n0 + R[1, 1] * n1 + R[1, 2] * n2 + P[2] * fx - P[0] * fz
    out[5] += R[2, 0] * n0 + R[2, 1] * n1 + R[2, 2] * n2 + P[0] * fy - P[1] * fx


@jit
def regressors(parent, R0, p, base, q, dq, ddq, Y):
    """Y (m, n, 10 n) over tables q, dq, ddq (m, n)."""
    motion = np.empty((parent.shape[0], 12))
    for m in range(q.shape[0]):
        link_motion(parent, R0, p, q[m], dq[m], ddq[m], base, motion)
        regressor(parent, R0, p, q[m], motion, Y[m])


@jit
def wrench_torques(parent, R0, p, q, wrench, out):
    """out (m, n) = J^T wrench of a wrench [f; m] (6,), base axes, at the last link's origin.

    `out` comes as zeros; joints that do not carry the last link keep theirs.
    """
    n = parent.shape[0]
    turn, origin = np.empty((n, 3, 3)), np.empty((n, 3))
    for m in range(q.shape[0]):
        for j in range(n):
            place_link(parent[j], R0[j], p[j], q[m, j], j, turn, origin)
        j = n - 1
        while j >= 0:
            ax, ay, az = turn[j, 0, 2], turn[j, 1, 2], turn[j, 2, 2]
            x = origin[n - 1, 0] - origin[j, 0]
            y = origin[n - 1, 1] - origin[j, 1]
            z = origin[n - 1, 2] - origin[j, 2]
            out[m, j] = (
                (ay * z - az * y) * wrench[0]
                + (az * x - ax * z) * wrench[1]
                + (ax * y - ay * x) * wrench[2]
                + ax * wrench[3]
                + ay * wrench[4]
                + az * wrench[5]
            )
            j = parent[j]


@jit
def place_link(up, R, P, angle, j, turn, origin):
    """Fill orientation turn[j] (3, 3) and origin[j] (3,) of link j in the base; `up` its parent."""
    c, s = np.cos(angle), np.sin(angle)
    for r in range(3):
        if up < 0:
            x, y, z = R[r, 0], R[r, 1], R[r, 2]
            origin[j, r] = P[r]
        else:
            T = turn[up]
            x = T[r, 0] * R[0, 0] + T[r, 1] * R[1, 0] + T[r, 2] * R[2, 0]
            y = T[r, 0] * R[0, 1] + T[r, 1] * R[1, 1] + T[r, 2] * R[2, 1]
            z = T[r, 0] * R[0, 2] + T[r, 1] * R[1, 2] + T[r, 2] * R[2, 2]
            origin[j, r] = origin[up, r] + T[r, 0] * P[0] + T[r, 1] * P[1] + T[r, 2] * P[2]
        turn[j, r, 0], turn[j, r, 1], turn[j, r, 2] = c * x + s * y, c * y - s * x, z


@dataclass(frozen=True, eq=False)
class RigidArm:
    """A fixed-base arm of revolute joints: what turns motion into torque.

    Attributes:
        parent: (n,) int64, index of the parent link, -1 for the base.
        R0, p: (n, 3, 3) and (n, 3), placement of each joint frame in its parent at q = 0.
        gravity: (3,) acceleration of gravity in base axes, m/s².
        theta: (n, 10) inertial parameters, tool included.
    """

    parent: np.ndarray
    R0: Array
    p: Array
    gravity: Array
    theta: Array

    @classmethod
    def of(cls, model: SelfModel) -> RigidArm:
        """The rigid part of a self model with its tool."""
        n = model.tree.n
        return cls(
            np.array(model.tree.parent, dtype=np.int64),
            np.ascontiguousarray(matrix_from_zxz(model.lam[:, :3])),
            np.ascontiguousarray(model.lam[:, 3:]),
            np.array(model.gravity),
            np.ascontiguousarray(model.theta_with_tool()[-n:]),
        )

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.parent)

    def changed(self, theta: Array | None = None, gravity: Array | None = None) -> RigidArm:
        """The same arm with other inertias or another gravity."""
        theta = self.theta if theta is None else np.ascontiguousarray(theta)
        return replace(self, theta=theta, gravity=self.gravity if gravity is None else gravity)

    def torque(self, q: Array, dq: Array, ddq: Array) -> Array:
        """tau (m, n), N m, for q, dq, ddq (m, n) rad, rad/s, rad/s²."""
        q, dq, ddq = (np.ascontiguousarray(x) for x in (q, dq, ddq))
        tau = np.empty_like(q)
        base = base_motion(self.gravity)
        rigid_torque(self.parent, self.R0, self.p, base, self.theta.ravel(), q, dq, ddq, tau)
        return tau

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y (m, n, 10 n): torque = Y @ theta.ravel()."""
        q, dq, ddq = (np.ascontiguousarray(x) for x in (q, dq, ddq))
        Y = np.empty((*q.shape, 10 * self.n))
        regressors(self.parent, self.R0, self.p, base_motion(self.gravity), q, dq, ddq, Y)
        return Y

    def wrench_torque(self, q: Array, wrench: Array) -> Array:
        """J^T wrench (m, n), N m: of a wrench [f; m] (6,), base axes, at the last link's origin."""
        out = np.zeros_like(q)
        wrench = np.asarray(wrench, dtype=np.float64)
        wrench_torques(self.parent, self.R0, self.p, np.ascontiguousarray(q), wrench, out)
        return out
