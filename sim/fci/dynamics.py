"""The robot's own model of itself, compiled: torques by recursion, frames and Jacobian.

PyBullet moves the arm; what the robot's firmware would compute (gravity, model torque, pose of
the end effector) is computed here, 20 µs a tick cheaper and with a load that may change.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sim.truth import Array


@njit(cache=True)
def torques(
    R0: Array, p0: Array, theta: Array, gravity: Array, q: Array, dq: Array, ddq: Array
) -> Array:
    """Inverse dynamics (n,) N m of the rigid arm, by Newton and Euler from link to link.

    Args:
        R0: (n, 3, 3) and p0: (n, 3), joint frames in the frame before at q = 0, axis z; m.
        theta: (n, 10) about the link-frame origins, as in `sim.truth.Truth`.
        gravity: (3,) m/s² in base axes.
        q: (n,) rad.
        dq: (n,) rad/s.
        ddq: (n,) rad/s².
    """
    n = len(q)
    E, step = np.empty((n, 3, 3)), np.empty((n, 3))
    force, moment = np.empty((n, 3)), np.empty((n, 3))
    w, dw, a = np.zeros(3), np.zeros(3), -gravity
    t, u, v = np.empty(3), np.empty(3), np.empty(3)
    for j in range(n):
        _turned(R0[j], np.cos(q[j]), np.sin(q[j]), E[j])
        _cross(dw, p0[j], t)
        _cross(w, p0[j], u)
        _cross(w, u, v)
        for i in range(3):
            step[j, i] = p0[j, i]
            u[i] = a[i] + t[i] + v[i]
        _into(E[j], u, a)
        _into(E[j], w, t)
        _into(E[j], dw, u)
        dw[0] = u[0] + t[1] * dq[j]
        dw[1] = u[1] - t[0] * dq[j]
        dw[2] = u[2] + ddq[j]
        w[0], w[1], w[2] = t[0], t[1], t[2] + dq[j]
        _body(theta[j], w, dw, a, force[j], moment[j])
    tau = np.empty(n)
    for j in range(n - 1, -1, -1):
        tau[j] = moment[j, 2]
        if j > 0:
            _out_of(E[j], force[j], t)
            _out_of(E[j], moment[j], u)
            _cross(step[j], t, v)
            for i in range(3):
                force[j - 1, i] += t[i]
                moment[j - 1, i] += u[i] + v[i]
    return tau


@njit(cache=True)
def _body(theta: Array, w: Array, dw: Array, a: Array, force: Array, moment: Array) -> None:
    """Force and moment about its origin that one link's motion takes."""
    m, x, y, z = theta[0], theta[1], theta[2], theta[3]
    xx, xy, xz, yy, yz, zz = theta[4], theta[5], theta[6], theta[7], theta[8], theta[9]
    c, t, u, h = np.array([x, y, z]), np.empty(3), np.empty(3), np.empty(3)
    _cross(dw, c, t)
    _cross(w, c, u)
    _cross(w, u, h)
    for i in range(3):
        force[i] = m * a[i] + t[i] + h[i]
    h[0] = xx * w[0] + xy * w[1] + xz * w[2]
    h[1] = xy * w[0] + yy * w[1] + yz * w[2]
    h[2] = xz * w[0] + yz * w[1] + zz * w[2]
    _cross(w, h, t)
    _cross(c, a, u)
    moment[0] = xx * dw[0] + xy * dw[1] + xz * dw[2] + t[0] + u[0]
    moment[1] = xy * dw[0] + yy * dw[1] + yz * dw[2] + t[1] + u[1]
    moment[2] = xz * dw[0] + yz * dw[1] + zz * dw[2] + t[2] + u[2]


@njit(cache=True)
def mass_matrix(R0: Array, p0: Array, theta: Array, q: Array) -> Array:
    """(n, n) kg m²: the torques of unit accelerations."""
    n = len(q)
    M, still, one = np.empty((n, n)), np.zeros(n), np.zeros(n)
    nothing = np.zeros(3)
    for j in range(n):
        one[j] = 1.0
        M[:, j] = torques(R0, p0, theta, nothing, q, still, one)
        one[j] = 0.0
    return M


@njit(cache=True)
def flange(R0: Array, p0: Array, q: Array, length: float, tool: Array) -> tuple[Array, Array]:
    """Pose of the end effector and its Jacobian, in base axes.

    Args:
        R0: (n, 3, 3) and p0: (n, 3), as in `torques`.
        q: (n,) rad.
        length: from the last joint frame to the flange along its z axis, m.
        tool: (4, 4), the end effector in the flange.

    Returns:
        (4, 4) pose and (6, n) Jacobian of its origin, linear part first.
    """
    n = len(q)
    R, work = np.eye(3), np.empty((3, 3))
    at, lever = np.zeros(3), np.empty(3)
    axes, origins = np.empty((n, 3)), np.empty((n, 3))
    for j in range(n):
        for i in range(3):
            at[i] += R[i, 0] * p0[j, 0] + R[i, 1] * p0[j, 1] + R[i, 2] * p0[j, 2]
        _turned(R0[j], np.cos(q[j]), np.sin(q[j]), work)
        R = R @ work
        for i in range(3):
            origins[j, i], axes[j, i] = at[i], R[i, 2]
    pose, J = np.eye(4), np.empty((6, n))
    pose[:3, :3] = R @ np.ascontiguousarray(tool[:3, :3])
    x, y, z = tool[0, 3], tool[1, 3], tool[2, 3] + length
    for i in range(3):
        pose[i, 3] = at[i] + R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
    for j in range(n):
        _cross(axes[j], pose[:3, 3] - origins[j], lever)
        for i in range(3):
            J[i, j], J[i + 3, j] = lever[i], axes[j, i]
    return pose, J


@njit(cache=True)
def wrench_at(pose: Array, jacobian: Array, tool: Array, torque: Array, least: float) -> Array:
    """Wrench (6,) [f; m] at a frame whose joint torques come nearest to `torque`, base axes.

    Args:
        pose: (4, 4) of the end effector.
        jacobian: (6, n) of its origin.
        tool: (4, 4), the frame in the end effector; the wrench acts at its origin.
        torque: (n,) N m.
        least: manipulability, the root of det(J J^T), below which there is no telling: zeros.
    """
    J, lever, shift = jacobian.copy(), np.zeros(3), np.empty(3)
    for i in range(3):
        for k in range(3):
            lever[i] += pose[i, k] * tool[k, 3]
    for j in range(J.shape[1]):
        _cross(J[3:, j], lever, shift)
        for i in range(3):
            J[i, j] += shift[i]
    square = J @ J.T
    wrench = np.zeros(6)
    if np.linalg.det(square) >= least * least:
        wrench[:] = np.linalg.solve(square, J @ torque)
    return wrench


@njit(cache=True)
def _turned(R0: Array, c: float, s: float, out: Array) -> None:
    """out becomes R0 Rz, the turn about z given by its cosine and sine."""
    for i in range(3):
        out[i, 0] = c * R0[i, 0] + s * R0[i, 1]
        out[i, 1] = c * R0[i, 1] - s * R0[i, 0]
        out[i, 2] = R0[i, 2]


@njit(cache=True)
def _into(E: Array, x: Array, out: Array) -> None:
    """out becomes E^T x: outer axes to inner ones."""
    for i in range(3):
        out[i] = E[0, i] * x[0] + E[1, i] * x[1] + E[2, i] * x[2]


@njit(cache=True)
def _out_of(E: Array, x: Array, out: Array) -> None:
    """out becomes E x: inner axes to outer ones."""
    for i in range(3):
        out[i] = E[i, 0] * x[0] + E[i, 1] * x[1] + E[i, 2] * x[2]


@njit(cache=True)
def _cross(a: Array, b: Array, out: Array) -> None:
    """out becomes a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
