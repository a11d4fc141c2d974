"""The FOP networks' formulas compiled for one sample at a time (numba), for the 1 kHz step.

The torch modules in `kinematics` and `dynamics` define the model; tests hold these kernels to
them at 1e-9. Placements come as R0 (n, 3, 3) and p (n, 3), the orientation and position of each
joint frame in its parent at q = 0. A motion row is [v, w, a, dw] (12,), a with gravity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile with numba: cached on disk, IEEE arithmetic as written, so that runs repeat."""
    return cast(F, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))


@jit
def rot_z_t(c, s, x, out):
    """out = Rz(q)^T x, with c, s = cos q, sin q."""
    out[0] = c * x[0] + s * x[1]
    out[1] = -s * x[0] + c * x[1]
    out[2] = x[2]


@jit
def link_motion(parent, R0, p, q, dq, ddq, base, out):
    """Motion of every moving link, eqs. 8a-8d (8c as in the reading notes).

    Args:
        parent: (n,) int64, index of the parent link, -1 for the base.
        R0, p: joint placements.
        q, dq, ddq: (n,) rad, rad/s, rad/s².
        base: (12,) motion of the base; at rest zeros but a = -gravity.
        out: (n, 12), filled.
    """
    x = np.empty(3)
    for j in range(q.shape[0]):
        m = base if parent[j] < 0 else out[parent[j]]
        P = p[j]
        R = R0[j]
        wx, wy, wz = m[3], m[4], m[5]
        ex, ey, ez = m[9], m[10], m[11]
        c, s = math.cos(q[j]), math.sin(q[j])
        o = out[j]
        # linear velocity (8a)
        ux = m[0] + wy * P[2] - wz * P[1]
        uy = m[1] + wz * P[0] - wx * P[2]
        uz = m[2] + wx * P[1] - wy * P[0]
        for k in range(3):
            x[k] = R[0, k] * ux + R[1, k] * uy + R[2, k] * uz
        rot_z_t(c, s, x, o[0:3])
        # angular velocity (8b), the parent's part first
        for k in range(3):
            x[k] = R[0, k] * wx + R[1, k] * wy + R[2, k] * wz
        rot_z_t(c, s, x, o[3:6])
        # linear acceleration (8c)
        wp = wx * P[0] + wy * P[1] + wz * P[2]
        ww = wx * wx + wy * wy + wz * wz
        ux = m[6] + ey * P[2] - ez * P[1] + wx * wp - ww * P[0]
        uy = m[7] + ez * P[0] - ex * P[2] + wy * wp - ww * P[1]
        uz = m[8] + ex * P[1] - ey * P[0] + wz * wp - ww * P[2]
        for k in range(3):
            x[k] = R[0, k] * ux + R[1, k] * uy + R[2, k] * uz
        rot_z_t(c, s, x, o[6:9])
        # angular acceleration (8d)
        for k in range(3):
            x[k] = R[0, k] * ex + R[1, k] * ey + R[2, k] * ez
        rot_z_t(c, s, x, o[9:12])
        o[9] += o[4] * dq[j]
        o[10] -= o[3] * dq[j]
        o[11] += ddq[j]
        o[5] += dq[j]


@jit
def body_wrench_regressor(m, W):
    """W (6, 10) of eq. 12 for a motion row m (12,): wrench [f; n] = W @ theta."""
    wx, wy, wz = m[3], m[4], m[5]
    ax, ay, az = m[6], m[7], m[8]
    ex, ey, ez = m[9], m[10], m[11]
    W[:] = 0.0
    W[0, 0], W[1, 0], W[2, 0] = ax, ay, az
    W[0, 1] = -wy * wy - wz * wz
    W[0, 2] = -ez + wx * wy
    W[0, 3] = ey + wx * wz
    W[1, 1] = ez + wx * wy
    W[1, 2] = -wx * wx - wz * wz
    W[1, 3] = -ex + wy * wz
    W[2, 1] = -ey + wx * wz
    W[2, 2] = ex + wy * wz
    W[2, 3] = -wx * wx - wy * wy
    W[3, 2], W[3, 3] = az, -ay
    W[4, 1], W[4, 3] = -az, ax
    W[5, 1], W[5, 2] = ay, -ax
    # [• dw] + [w x][• w] for XX XY XZ YY YZ ZZ
    W[3, 4], W[3, 5], W[3, 6] = ex, ey - wx * wz, ez + wx * wy
    W[3, 7], W[3, 8], W[3, 9] = -wy * wz, wy * wy - wz * wz, wy * wz
    W[4, 4], W[4, 5], W[4, 6] = wx * wz, ex + wy * wz, wz * wz - wx * wx
    W[4, 7], W[4, 8], W[4, 9] = ey, ez - wx * wy, -wx * wz
    W[5, 4], W[5, 5], W[5, 6] = -wx * wy, wx * wx - wy * wy, ex - wy * wz
    W[5, 7], W[5, 8], W[5, 9] = wx * wy, ey + wx * wz, ez


@jit
def regressor(parent, R0, p, q, motion, Y):
    """Fill the fixed-base regressor Y (n, 10 n): tau = Y @ theta (eqs. 11-16).

    Args:
        motion: (n, 12) from `link_motion`.
        Y: (n, 10 n), overwritten.
    """
    n = q.shape[0]
    Y[:] = 0.0
    W = np.empty((6, 10))
    T = np.empty((6, 10))
    for k in range(n):
        body_wrench_regressor(motion[k], W)
        j = k
        while True:
            for i in range(10):
                Y[j, 10 * k + i] = W[5, i]
            up = parent[j]
            if up < 0:
                break
            _carry_up(R0[j], p[j], math.cos(q[j]), math.sin(q[j]), W, T)
            W, T = T, W
            j = up


@jit
def _carry_up(R, P, c, s, W, out):
    """out = T_j W (eq. 14a): wrench columns of link j expressed at and in its parent's frame."""
    for i in range(W.shape[1]):
        for h in (0, 3):
            x = c * W[h, i] - s * W[h + 1, i]
            y = s * W[h, i] + c * W[h + 1, i]
            z = W[h + 2, i]
            for r in range(3):
                out[h + r, i] = R[r, 0] * x + R[r, 1] * y + R[r, 2] * z
        fx, fy, fz = out[0, i], out[1, i], out[2, i]
        out[3, i] += P[1] * fz - P[2] * fy
        out[4, i] += P[2] * fx - P[0] * fz
        out[5, i] += P[0] * fy - P[1] * fx
