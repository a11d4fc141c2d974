"""Motion of the links and torques of the joints of a tree of rigid bodies: Newton and Euler.

The simulator's only formulas of rigid bodies beside PyBullet's own. Compiled, and written in loops
over single numbers, which compile four times as fast as array terms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., object])
Array = NDArray[np.float64]


def compiled(function: F) -> F:
    """Compile when first called, and keep that on disk.

    What is kept is named after the module, too: it refers to classes of this package by name, and
    where somebody else's module is called `sim` this package has another one.
    """
    function.__qualname__ = f"{function.__module__}.{function.__qualname__}"
    return cast(F, njit(cache=True)(function))


V, W, A, DW = range(4)  # rows of a body's motion


class Frames(NamedTuple):
    """Where the joints of a tree are.

    Attributes:
        parent: (n,) link that each joint hangs on, -1 the base; parents come first.
        R: (n, 3, 3) orientation of joint frame j in its parent's frame at q_j = 0; axis z.
        p: (n, 3) its position there, m.
    """

    parent: NDArray[np.int64]
    R: Array
    p: Array


def resting(gravity: Array) -> Array:
    """(4, 3) motion of a base at rest under gravity (3,) m/s², as `link_motion` wants it."""
    base = np.zeros((4, 3))
    base[A] = -gravity
    return base


@compiled
def link_motion(frames: Frames, base: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """What ideal sensors at the origins of the link frames would read.

    A joint's frame moves like a point of a turning platform, its parent; the joint then adds
    [0 0 dq] to the angular velocity and [0 0 ddq] + w x [0 0 dq] to its rate.

    Args:
        frames: of the tree.
        base: (4, 3) motion of the base, rows as returned.
        q: (n,) rad.
        dq: (n,) rad/s.
        ddq: (n,) rad/s².

    Returns:
        (n, 4, 3), each link in its own axes: velocity of the origin (m/s), angular velocity
        (rad/s), acceleration of the origin minus gravity (what an accelerometer reads, m/s²),
        angular acceleration (rad/s²).
    """
    n = len(q)
    out, E = np.empty((n, 4, 3)), np.empty((3, 3))
    swing, pull, at = np.empty(3), np.empty(3), np.empty(3)
    for j in range(n):
        before = base if frames.parent[j] < 0 else out[frames.parent[j]]
        own, p = out[j], frames.p[j]
        turned(frames.R[j], q[j], E)
        cross(before[W], p, swing)
        for i in range(3):
            at[i] = before[V, i] + swing[i]
        into(E, at, own[V])
        cross(before[W], swing, pull)
        cross(before[DW], p, swing)
        for i in range(3):
            at[i] = before[A, i] + swing[i] + pull[i]
        into(E, at, own[A])
        into(E, before[W], own[W])
        into(E, before[DW], own[DW])
        own[DW, 0] += own[W, 1] * dq[j]
        own[DW, 1] -= own[W, 0] * dq[j]
        own[DW, 2] += ddq[j]
        own[W, 2] += dq[j]
    return out


@compiled
def torques(frames: Frames, theta: Array, base: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """Inverse dynamics (n,) N m.

    Args:
        frames: of the tree.
        theta: (n, 10) [m mX mY mZ XX XY XZ YY YZ ZZ] about the link-frame origins.
        base: (4, 3) motion of the base, see `link_motion`; `resting` for a fixed one.
        q: (n,) rad.
        dq: (n,) rad/s.
        ddq: (n,) rad/s².
    """
    n = len(q)
    motion = link_motion(frames, base, q, dq, ddq)
    force, moment = np.empty((n, 3)), np.empty((n, 3))
    for j in range(n):
        _body(theta[j], motion[j], force[j], moment[j])
    E, t, u, v, tau = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(n)
    for j in range(n - 1, -1, -1):
        tau[j] = moment[j, 2]
        k = frames.parent[j]
        if k >= 0:
            turned(frames.R[j], q[j], E)
            out_of(E, force[j], t)
            out_of(E, moment[j], u)
            cross(frames.p[j], t, v)
            for i in range(3):
                force[k, i] += t[i]
                moment[k, i] += u[i] + v[i]
    return tau


@compiled
def _body(theta: Array, motion: Array, force: Array, moment: Array) -> None:
    """Force and moment about its origin that one link's motion takes."""
    m, c, w, dw, a = theta[0], theta[1:4], motion[W], motion[DW], motion[A]
    xx, xy, xz, yy, yz, zz = theta[4], theta[5], theta[6], theta[7], theta[8], theta[9]
    t, u, h = np.empty(3), np.empty(3), np.empty(3)
    cross(dw, c, t)
    cross(w, c, u)
    cross(w, u, h)
    for i in range(3):
        force[i] = m * a[i] + t[i] + h[i]
    h[0] = xx * w[0] + xy * w[1] + xz * w[2]
    h[1] = xy * w[0] + yy * w[1] + yz * w[2]
    h[2] = xz * w[0] + yz * w[1] + zz * w[2]
    cross(w, h, t)
    cross(c, a, u)
    moment[0] = xx * dw[0] + xy * dw[1] + xz * dw[2] + t[0] + u[0]
    moment[1] = xy * dw[0] + yy * dw[1] + yz * dw[2] + t[1] + u[1]
    moment[2] = xz * dw[0] + yz * dw[1] + zz * dw[2] + t[2] + u[2]


@compiled
def mass_matrix(frames: Frames, theta: Array, q: Array) -> Array:
    """(n, n) kg m²: the torques of unit accelerations."""
    n = len(q)
    M, still, one, base = np.empty((n, n)), np.zeros(n), np.zeros(n), np.zeros((4, 3))
    for j in range(n):
        one[j] = 1.0
        M[:, j] = torques(frames, theta, base, q, still, one)
        one[j] = 0.0
    return M


@compiled
def end_effector(frames: Frames, q: Array, tool: Array) -> tuple[Array, Array]:
    """Pose of the end of a serial arm and its Jacobian, in base axes.

    Args:
        frames: each joint on the link before it.
        q: (n,) rad.
        tool: (4, 4) the end in the last link's frame.

    Returns:
        (4, 4) pose and (6, n) Jacobian of its origin, linear part first.
    """
    n = len(q)
    R, E, step, lever = np.eye(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    at = np.zeros(3)
    axes, origins = np.empty((n, 3)), np.empty((n, 3))
    for j in range(n):
        out_of(R, frames.p[j], step)
        turned(frames.R[j], q[j], E)
        R = R @ E
        for i in range(3):
            at[i] += step[i]
            origins[j, i], axes[j, i] = at[i], R[i, 2]
    pose, J = np.eye(4), np.empty((6, n))
    pose[:3, :3] = R @ np.ascontiguousarray(tool[:3, :3])
    for i in range(3):
        at[i] += R[i, 0] * tool[0, 3] + R[i, 1] * tool[1, 3] + R[i, 2] * tool[2, 3]
        pose[i, 3] = at[i]
    for j in range(n):
        for i in range(3):
            step[i] = at[i] - origins[j, i]
        cross(axes[j], step, lever)
        for i in range(3):
            J[i, j], J[i + 3, j] = lever[i], axes[j, i]
    return pose, J


@compiled
def turned(R0: Array, q: float, out: Array) -> None:
    """out becomes R0 Rz(q)."""
    c, s = np.cos(q), np.sin(q)
    for i in range(3):
        out[i, 0] = c * R0[i, 0] + s * R0[i, 1]
        out[i, 1] = c * R0[i, 1] - s * R0[i, 0]
        out[i, 2] = R0[i, 2]


@compiled
def into(E: Array, x: Array, out: Array) -> None:
    """out becomes E^T x: outer axes to inner ones."""
    for i in range(3):
        out[i] = E[0, i] * x[0] + E[1, i] * x[1] + E[2, i] * x[2]


@compiled
def out_of(E: Array, x: Array, out: Array) -> None:
    """out becomes E x: inner axes to outer ones."""
    for i in range(3):
        out[i] = E[i, 0] * x[0] + E[i, 1] * x[1] + E[i, 2] * x[2]


@compiled
def cross(a: Array, b: Array, out: Array) -> None:
    """out becomes a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
