"""What sensors at the link-frame origins would read: the simulator's own recursion.

Everything is added up in base axes and turned into the link frames at the end. Compiled: the
same in numpy takes 70 µs.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from drivers.interface import LinkMotion
from sim.truth import Array, Truth


def link_motion(truth: Truth, q: Array, dq: Array, ddq: Array) -> LinkMotion:
    """Twist [v; w] and acceleration [a; dw] of every link, (n, 6) each, in the link frames.

    Args:
        truth: of the arm; its frames and its gravity are used.
        q: (n,) rad.
        dq: (n,) rad/s.
        ddq: (n,) rad/s².

    Returns:
        Velocity of the origin and angular velocity; acceleration of the origin minus gravity
        (what an accelerometer reads) and angular acceleration.
    """
    twist, accel = np.empty((truth.n, 6)), np.empty((truth.n, 6))
    _walk(truth.R, truth.p, truth.gravity, q, dq, ddq, twist, accel)
    return LinkMotion(twist, accel)


@njit(cache=True)
def _walk(
    R0: Array,
    p0: Array,
    gravity: Array,
    q: Array,
    dq: Array,
    ddq: Array,
    twist: Array,
    accel: Array,
) -> None:
    """From link to link outwards; fills `twist` and `accel` (n, 6).

    Written in loops over single numbers, which compile four times as fast as array terms.
    """
    R, turned = np.eye(3), np.empty((3, 3))
    step, turning = np.empty(3), np.empty(3)
    v, w, dw, a = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    swing, pull = np.empty(3), np.empty(3)
    for i in range(3):
        a[i] = -gravity[i]
    for j in range(len(q)):
        for i in range(3):
            step[i] = R[i, 0] * p0[j, 0] + R[i, 1] * p0[j, 1] + R[i, 2] * p0[j, 2]
        _cross(w, step, swing)
        _add(v, swing)
        _cross(dw, step, pull)
        _add(a, pull)
        _cross(w, swing, pull)
        _add(a, pull)
        _next_axes(R, R0[j], np.cos(q[j]), np.sin(q[j]), turned)
        for i in range(3):
            turning[i] = dq[j] * R[i, 2]
        _cross(w, turning, pull)
        for i in range(3):
            dw[i] += ddq[j] * R[i, 2] + pull[i]
        _add(w, turning)
        for i in range(3):
            twist[j, i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]
            twist[j, i + 3] = R[0, i] * w[0] + R[1, i] * w[1] + R[2, i] * w[2]
            accel[j, i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]
            accel[j, i + 3] = R[0, i] * dw[0] + R[1, i] * dw[1] + R[2, i] * dw[2]


@njit(cache=True)
def _next_axes(R: Array, R0: Array, c: float, s: float, work: Array) -> None:
    """R becomes R R0 Rz, the turn about z given by its cosine and sine."""
    for i in range(3):
        for k in range(3):
            work[i, k] = R[i, 0] * R0[0, k] + R[i, 1] * R0[1, k] + R[i, 2] * R0[2, k]
    for i in range(3):
        R[i, 0] = c * work[i, 0] + s * work[i, 1]
        R[i, 1] = c * work[i, 1] - s * work[i, 0]
        R[i, 2] = work[i, 2]


@njit(cache=True)
def _cross(a: Array, b: Array, out: Array) -> None:
    """out becomes a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _add(total: Array, part: Array) -> None:
    """total grows by part."""
    for i in range(3):
        total[i] += part[i]


@njit(cache=True)
def flange_torque(R0: Array, p0: Array, q: Array, wrench: Array, torque: Array) -> None:
    """Add J^T wrench to `torque` (n,), N m.

    Args:
        R0: (n, 3, 3) and p0: (n, 3), the frames of a truth.
        q: (n,) rad.
        wrench: (6,) [f; m] on the origin of the last link, base axes, N and N m.
        torque: (n,), changed.
    """
    n = len(q)
    R, turned = np.eye(3), np.empty((3, 3))
    axes, origins = np.empty((n, 3)), np.empty((n, 3))
    at, lever = np.zeros(3), np.empty(3)
    for j in range(n):
        for i in range(3):
            at[i] += R[i, 0] * p0[j, 0] + R[i, 1] * p0[j, 1] + R[i, 2] * p0[j, 2]
        _next_axes(R, R0[j], np.cos(q[j]), np.sin(q[j]), turned)
        for i in range(3):
            origins[j, i], axes[j, i] = at[i], R[i, 2]
    for j in range(n):
        _cross(at - origins[j], wrench[:3], lever)
        for i in range(3):
            torque[j] += axes[j, i] * (lever[i] + wrench[3 + i])
