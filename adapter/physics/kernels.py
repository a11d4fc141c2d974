"""The paper's formulas compiled (numba): one sample at a time for the 1 kHz step, and tables.

`networks` has the same formulas in torch and defines them; tests hold the two together at 1e-9.

A motion row is [v w a dw] (12,) of one body in its own frame, `a` with gravity (what an
accelerometer reads). Wrenches are [f; m] (6,). The networks carry wrenches from link to link; here
each goes to the base at once: about the base's origin the wrenches of a sub-tree add up, and the
torque of joint j is their product with the line of its axis. Eqs. 14c and 16 say the same.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, cast

import numba
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from adapter.model.spatial import Array, matrix_from_zxz

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F, sums_in_any_order: bool = False) -> F:
    """Compile with numba: cached on disk, IEEE arithmetic as written, so that runs repeat.

    With `sums_in_any_order` the compiler may choose the order of sums, for speed; it chooses once,
    so that runs on one machine still repeat.

    A kernel holds those that it calls, but numba looks only at a kernel's own file for changes:
    after an upgrade an old one would go on. So what is cached is of all kernels as they are now.
    """
    freedom = {"reassoc"} if sums_in_any_order else False
    compiled = numba.njit(cache=True, fastmath=freedom, error_model="numpy")(function)
    file = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if file is not None:  # none where nothing can be written
        file._source_stamp = file._source_stamp, all_kernels()
    return cast(F, compiled)


@cache
def all_kernels() -> str:
    """What the files of this package that hold kernels say, in short."""
    found = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        text = path.read_bytes()
        if b"\n@jit\n" in text:
            found.update(text)
    return found.hexdigest()


def _borrowed(_: Any, kind: types.Type) -> Any:
    return kind(kind), lambda context, builder, _, given: _uncounted(context, builder, kind, *given)


def _uncounted(context: Any, builder: Any, kind: types.Type, value: Any) -> Any:
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        parts = cgutils.unpack_tuple(builder, value)
        kinds = kind.types  # type: ignore[attr-defined]
        bare = [_uncounted(context, builder, *x) for x in zip(kinds, parts, strict=True)]
        return context.make_tuple(builder, kind, bare)
    return value


# Arrays, alone or in tuples, that whoever calls a kernel keeps until it returns. numba counts who
# holds an array, with locked instructions wherever a function hands one to another: half of what
# small kernels cost. Of these nobody counts; a kernel must neither return one nor lend what it made
# itself, which nobody would hold.
borrowed = cast(Callable[[Any], Any], intrinsic(_borrowed))


class Frames(NamedTuple):
    """Where the joints of a tree are, as compiled code takes it.

    Attributes:
        parent: (n,) int64, index of the link that each joint hangs on, -1 for the base.
        R0, p: (n, 3, 3) and (n, 3) m, frame j in frame i at q = 0.
        slides: (n,) bool, joints that slide along their z; the others turn about it.
    """

    parent: np.ndarray
    R0: Array
    p: Array
    slides: np.ndarray


class JointMotion(NamedTuple):
    """Joint angles (rad), velocities (rad/s), accelerations (rad/s²): (n,), or (m, n) in tables.

    Of a joint that slides m, m/s, m/s².
    """

    q: Array
    dq: Array
    ddq: Array


class Joints(Protocol):
    """Of a tree what its frames are made of; see `model.tree.Tree`."""

    @property
    def parent(self) -> Sequence[int]: ...

    @property
    def slides(self) -> Sequence[bool]: ...


def frames_of(tree: Joints, lam: Array) -> Frames:
    """The frames that λ (n, 6) describes."""
    lam = np.asarray(lam, dtype=np.float64)
    return placed(tree, matrix_from_zxz(lam[:, :3]), lam[:, 3:])


def placed(tree: Joints, R0: Array, p: Array) -> Frames:
    """Frames at R0 (n, 3, 3), p (n, 3) m; these themselves where they lie in one piece."""
    R0, p = np.ascontiguousarray(R0), np.ascontiguousarray(p)
    return Frames(np.array(tree.parent, dtype=np.int64), R0, p, np.array(tree.slides))


def base_at_rest(gravity: Array) -> Array:
    """Motion row (12,) of a base at rest: nothing but a = -gravity (base axes, m/s²)."""
    base = np.zeros(12)
    base[6:9] = -np.asarray(gravity)
    return base


# Motion of links: eqs. 8 to 10


@jit
def into_link(R, c, s, x, y, z):
    """R_ijᵀ [x y z]: a vector of frame i in axes of frame j; R = R0_j, c and s of q_j (eq. 9)."""
    u = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
    v = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
    return c * u + s * v, -s * u + c * v, R[0, 2] * x + R[1, 2] * y + R[2, 2] * z


@jit
def link_motion(frames, joints, base, out):
    """Motion of every moving link, eqs. 8a to 8d (8c as in the reading notes).

    Of a joint that slides: R_ij = R0_j and p_ij = p_j + q_j z; v_j has dq_j z more and a_j has
    ddq_j z + 2 w_j x dq_j z, where eqs. 8b and 8d put dq_j and ddq_j of one that turns.

    Args:
        frames: `Frames`.
        joints: `JointMotion` (n,).
        base: (12,) motion row of the base.
        out: (n, 12) motion rows, filled.
    """
    parent, R0, p, slides = frames
    q, dq, ddq = joints
    for j in range(q.shape[0]):
        m = base if parent[j] < 0 else out[parent[j]]
        R, P, o = R0[j], p[j], out[j]
        wx, wy, wz = m[3], m[4], m[5]
        ex, ey, ez = m[9], m[10], m[11]
        px, py, pz = P[0], P[1], P[2]
        turn, spin, slide = q[j], dq[j], 0.0
        if slides[j]:
            turn, spin, slide = 0.0, 0.0, dq[j]
            px, py, pz = px + R[0, 2] * q[j], py + R[1, 2] * q[j], pz + R[2, 2] * q[j]
        c, s = math.cos(turn), math.sin(turn)
        # 8a
        ux = m[0] + wy * pz - wz * py
        uy = m[1] + wz * px - wx * pz
        uz = m[2] + wx * py - wy * px
        o[0], o[1], o[2] = into_link(R, c, s, ux, uy, uz)
        # 8b, the parent's part first: 8d wants it
        o[3], o[4], o[5] = into_link(R, c, s, wx, wy, wz)
        # 8c, w x (w x p) written as w (w.p) - p |w|²
        wp = wx * px + wy * py + wz * pz
        ww = wx * wx + wy * wy + wz * wz
        ux = m[6] + ey * pz - ez * py + wx * wp - ww * px
        uy = m[7] + ez * px - ex * pz + wy * wp - ww * py
        uz = m[8] + ex * py - ey * px + wz * wp - ww * pz
        o[6], o[7], o[8] = into_link(R, c, s, ux, uy, uz)
        spins = (spin, 0.0 if slides[j] else ddq[j])
        o[9], o[10], o[11] = link_spin(R, c, s, (ex, ey, ez), (o[3], o[4]), spins)
        if slides[j]:
            o[2] += slide
            o[6] += 2.0 * slide * o[4]
            o[7] -= 2.0 * slide * o[3]
            o[8] += ddq[j]
        o[5] += spin


@jit
def link_spin(R, c, s, dw, w, rates):
    """Angular acceleration of link j from its parent's (eq. 8d), rad/s².

    Args:
        R, c, s: as for `into_link`.
        dw: the three numbers of the parent, in its frame.
        w: x and y of link j's own angular velocity, in its frame.
        rates: dq and ddq of the joint.
    """
    x, y, z = into_link(R, c, s, dw[0], dw[1], dw[2])
    return x + w[1] * rates[0], y - w[0] * rates[0], z + rates[1]


@jit
def place_frames(frames, q, R, o):
    """Orientation R (n, 3, 3) and origin o (n, 3) of every link frame in the base, filled."""
    parent, R0, p, slides = frames
    for j in range(q.shape[0]):
        turn, slide = (0.0, q[j]) if slides[j] else (q[j], 0.0)
        c, s = math.cos(turn), math.sin(turn)
        i = parent[j]
        for r in range(3):
            if i < 0:
                x, y, z, origin = R0[j, r, 0], R0[j, r, 1], R0[j, r, 2], p[j, r]
            else:
                x, y, z, origin = 0.0, 0.0, 0.0, o[i, r]
                for k in range(3):
                    t = R[i, r, k]
                    x += t * R0[j, k, 0]
                    y += t * R0[j, k, 1]
                    z += t * R0[j, k, 2]
                    origin += t * p[j, k]
            R[j, r, 0], R[j, r, 1], R[j, r, 2] = c * x + s * y, c * y - s * x, z
            o[j, r] = origin + slide * z


# Wrenches of bodies: eqs. 11 to 14


@jit
def body_wrench(m, theta, out):
    """Wrench out (6,) of one body at its frame's origin (eqs. 11, 12).

    Args:
        m: (12,) motion row; theta: (10,) parameters of the body.
    """
    wx, wy, wz = m[3], m[4], m[5]
    ax, ay, az = m[6], m[7], m[8]
    ex, ey, ez = m[9], m[10], m[11]
    mass, hx, hy, hz = theta[0], theta[1], theta[2], theta[3]
    XX, XY, XZ, YY, YZ, ZZ = theta[4], theta[5], theta[6], theta[7], theta[8], theta[9]
    # I w; and w x (w x h) written as w (w.h) - h |w|²
    lx = XX * wx + XY * wy + XZ * wz
    ly = XY * wx + YY * wy + YZ * wz
    lz = XZ * wx + YZ * wy + ZZ * wz
    wh = wx * hx + wy * hy + wz * hz
    ww = wx * wx + wy * wy + wz * wz
    out[0] = mass * ax + ey * hz - ez * hy + wx * wh - ww * hx
    out[1] = mass * ay + ez * hx - ex * hz + wy * wh - ww * hy
    out[2] = mass * az + ex * hy - ey * hx + wz * wh - ww * hz
    out[3] = XX * ex + XY * ey + XZ * ez + wy * lz - wz * ly + hy * az - hz * ay
    out[4] = XY * ex + YY * ey + YZ * ez + wz * lx - wx * lz + hz * ax - hx * az
    out[5] = XZ * ex + YZ * ey + ZZ * ez + wx * ly - wy * lx + hx * ay - hy * ax


@jit
def body_wrench_regressor(m, W):
    """W (6, 10) of eq. 12, filled: `body_wrench` = W theta for a motion row m (12,)."""
    wx, wy, wz = m[3], m[4], m[5]
    ax, ay, az = m[6], m[7], m[8]
    ex, ey, ez = m[9], m[10], m[11]
    W[:] = 0.0
    W[0, 0], W[1, 0], W[2, 0] = ax, ay, az
    # [dw x] + [w x][w x] for the first moments
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
def transfer_one(R, o, w, out):
    """`transfer_wrench` of one wrench w (6,) into out (6,)."""
    fx = R[0, 0] * w[0] + R[0, 1] * w[1] + R[0, 2] * w[2]
    fy = R[1, 0] * w[0] + R[1, 1] * w[1] + R[1, 2] * w[2]
    fz = R[2, 0] * w[0] + R[2, 1] * w[1] + R[2, 2] * w[2]
    mx = R[0, 0] * w[3] + R[0, 1] * w[4] + R[0, 2] * w[5]
    my = R[1, 0] * w[3] + R[1, 1] * w[4] + R[1, 2] * w[5]
    mz = R[2, 0] * w[3] + R[2, 1] * w[4] + R[2, 2] * w[5]
    out[0], out[1], out[2] = fx, fy, fz
    out[3] = mx + o[1] * fz - o[2] * fy
    out[4] = my + o[2] * fx - o[0] * fz
    out[5] = mz + o[0] * fy - o[1] * fx


@jit
def transfer_wrench(R, o, W, out):
    """Wrenches of a frame as wrenches about another frame's origin, in its axes (eq. 14a).

    Args:
        R, o: (3, 3) and (3,), the frame in the other one (R_ij, p_ij; or in the base).
        W: (6, k), one wrench a column, in the frame's axes.
        out: (6, k), filled.
    """
    for i in range(W.shape[1]):
        transfer_one(R, o, W[:, i], out[:, i])


@jit
def axis_line(R, o, slides):
    """[o x z, z], six numbers: the axis z of a joint whose frame is at R (3, 3), o (3,).

    Of one that `slides` [z, 0]: its force is the part of the wrench's force along z.
    """
    x, y, z = R[0, 2], R[1, 2], R[2, 2]
    a, b, c = o[1] * z - o[2] * y, o[2] * x - o[0] * z, o[0] * y - o[1] * x
    slide, turn = (1.0, 0.0) if slides else (0.0, 1.0)  # no branch: what calls it stays vectorised
    return (
        slide * x + turn * a,
        slide * y + turn * b,
        slide * z + turn * c,
        turn * x,
        turn * y,
        turn * z,
    )


@jit
def moment_about(line, w):
    """Moment of a wrench w (6,) on the base about an axis, or its force along it (`axis_line`)."""
    force = line[0] * w[0] + line[1] * w[1] + line[2] * w[2]
    return force + line[3] * w[3] + line[4] * w[4] + line[5] * w[5]


@jit
def axis_moment(R, o, slides, B, out):
    """What out (k,) a joint feels of wrenches on the base B (6, k), one a column (eq. 16).

    Args:
        R, o: (3, 3) and (3,), the joint's frame in the base; slides: whether it slides.
    """
    line = axis_line(R, o, slides)
    for i in range(B.shape[1]):
        out[i] = moment_about(line, B[:, i])


# Torques of one sample: eqs. 14 to 16. With a floating base the base comes first: its wrench
# [f; m] in its own frame among the torques, its ten parameters in theta.


@jit
def inverse_dynamics(frames, theta, q, motion, base, tau):
    """Torques that a motion takes, N m, and N of joints that slide.

    Args:
        frames: `Frames`; theta: (bodies, 10).
        q: (n,) rad; motion: (n, 12) from `link_motion`; base: (12,) motion row of the base.
        tau: (n,), or (6 + n,) where theta has a base; filled.
    """
    n = q.shape[0]
    first = theta.shape[0] - n
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    own, total = np.empty(6), np.zeros((n + 1, 6))
    place_frames(frames, q, R, o)
    if first:
        body_wrench(base, theta[0], total[0])
    for j in range(n):
        body_wrench(motion[j], theta[first + j], own)
        transfer_one(R[j], o[j], own, total[j + 1])
    for j in range(n - 1, -1, -1):
        tau[6 * first + j] = moment_about(axis_line(R[j], o[j], frames.slides[j]), total[j + 1])
        below = total[frames.parent[j] + 1]
        for r in range(6):
            below[r] += total[j + 1, r]
    for r in range(6 * first):
        tau[r] = total[0, r]


@jit
def regressor(frames, q, motion, base, Y):
    """Regressor of one sample: `inverse_dynamics` = Y theta, theta's rows one after the other.

    Args:
        frames, q, motion, base: as for `inverse_dynamics`.
        Y: (n, 10 n), or (6 + n, 10 (n + 1)) with the base; filled.
    """
    n = q.shape[0]
    first = Y.shape[1] // 10 - n
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    W, B = np.empty((6, 10)), np.empty((6, 10))
    place_frames(frames, q, R, o)
    Y[:] = 0.0
    if first:
        body_wrench_regressor(base, W)
        Y[:6, :10] = W
    for k in range(n):
        body_wrench_regressor(motion[k], W)
        transfer_wrench(R[k], o[k], W, B)
        columns = slice(10 * (first + k), 10 * (first + k + 1))
        if first:
            Y[:6, columns] = B
        j = k
        while j >= 0:
            axis_moment(R[j], o[j], frames.slides[j], B, Y[6 * first + j, columns])
            j = frames.parent[j]


@jit
def momenta(frames, theta, q, dq, gravity, out):
    """Momentum of a fixed-base arm and what changes it beside the motors, at one instant.

    With p = M(q) dq and the kinetic energy T, Lagrange's equations say dp/dt = tau + dT/dq - g.
    The momentum of a sub-tree H = [l; a] about the base's origin gives both: p_j = S_j . H_j with
    the joint's line S_j, and dT/dq_j = H_j . (V_j x S_j) with the link's twist V_j.

    Args:
        frames: `Frames`; theta: (n, 10).
        q, dq: (n,) rad, rad/s; gravity: (3,) m/s² in base axes.
        out: (3, n), filled: p N m s, dT/dq N m, g N m; of a joint that slides N s, N, N.
    """
    n = q.shape[0]
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    motion, own, up = np.empty((n, 12)), np.empty(6), np.empty(3)
    momentum, weight = np.zeros((n + 1, 6)), np.zeros((n + 1, 6))
    place_frames(frames, q, R, o)
    link_motion(frames, JointMotion(q, dq, np.zeros(n)), np.zeros(12), motion)
    for j in range(n):
        body_momentum(motion[j], theta[j], own)
        transfer_one(R[j], o[j], own, momentum[j + 1])
        for r in range(3):
            up[r] = -R[j, 0, r] * gravity[0] - R[j, 1, r] * gravity[1] - R[j, 2, r] * gravity[2]
            own[r] = theta[j, 0] * up[r]
        own[3] = theta[j, 2] * up[2] - theta[j, 3] * up[1]
        own[4] = theta[j, 3] * up[0] - theta[j, 1] * up[2]
        own[5] = theta[j, 1] * up[1] - theta[j, 2] * up[0]
        transfer_one(R[j], o[j], own, weight[j + 1])
    for j in range(n - 1, -1, -1):
        line, H = axis_line(R[j], o[j], frames.slides[j]), momentum[j + 1]
        out[0, j] = moment_about(line, H)
        out[1, j] = energy_slope(R[j], o[j], motion[j], line, H)
        out[2, j] = moment_about(line, weight[j + 1])
        below = frames.parent[j] + 1
        for r in range(6):
            momentum[below, r] += momentum[j + 1, r]
            weight[below, r] += weight[j + 1, r]


@jit
def body_momentum(m, theta, out):
    """Momentum out (6,) [l; a] of one body about its frame's origin; arguments as `body_wrench`."""
    vx, vy, vz, wx, wy, wz = m[0], m[1], m[2], m[3], m[4], m[5]
    mass, hx, hy, hz = theta[0], theta[1], theta[2], theta[3]
    out[0] = mass * vx + wy * hz - wz * hy
    out[1] = mass * vy + wz * hx - wx * hz
    out[2] = mass * vz + wx * hy - wy * hx
    out[3] = theta[4] * wx + theta[5] * wy + theta[6] * wz + hy * vz - hz * vy
    out[4] = theta[5] * wx + theta[7] * wy + theta[8] * wz + hz * vx - hx * vz
    out[5] = theta[6] * wx + theta[8] * wy + theta[9] * wz + hx * vy - hy * vx


@jit
def energy_slope(R, o, m, line, H):
    """H . (V x S): how the kinetic energy of a sub-tree changes with its joint's angle, N m.

    Args:
        R, o: (3, 3) and (3,), the joint's frame in the base; m: (12,) motion row of its link.
        line: S of `axis_line`; H: (6,) momentum of the sub-tree about the base's origin.
    """
    w, v = R @ m[3:6], R @ m[:3]
    vx = v[0] + o[1] * w[2] - o[2] * w[1]  # of the link's point at the base's origin
    vy = v[1] + o[2] * w[0] - o[0] * w[2]
    vz = v[2] + o[0] * w[1] - o[1] * w[0]
    a, b, c, x, y, z = line
    linear = (
        H[0] * (w[1] * c - w[2] * b + vy * z - vz * y)
        + H[1] * (w[2] * a - w[0] * c + vz * x - vx * z)
        + H[2] * (w[0] * b - w[1] * a + vx * y - vy * x)
    )
    angular = H[3] * (w[1] * z - w[2] * y) + H[4] * (w[2] * x - w[0] * z)
    return linear + angular + H[5] * (w[0] * y - w[1] * x)


# Tables of m samples. `base` is (m, 12), or (1, 12) where it is the same for all.


@jit
def link_motions(frames, joints, base, out):
    """`link_motion` of every sample: out (m, n, 12), filled."""
    q, dq, ddq = joints
    for m in range(q.shape[0]):
        k = base[min(m, base.shape[0] - 1)]
        link_motion(frames, JointMotion(q[m], dq[m], ddq[m]), k, out[m])


@jit
def torques(frames, theta, joints, base, tau):
    """`inverse_dynamics` of every sample: tau (m, rows), filled."""
    q, dq, ddq = joints
    motion = np.empty((q.shape[1], 12))
    for m in range(q.shape[0]):
        k = base[min(m, base.shape[0] - 1)]
        link_motion(frames, JointMotion(q[m], dq[m], ddq[m]), k, motion)
        inverse_dynamics(frames, theta, q[m], motion, k, tau[m])


@jit
def regressors(frames, joints, base, Y):
    """`regressor` of every sample: Y (m, rows, 10 bodies), filled."""
    q, dq, ddq = joints
    motion = np.empty((q.shape[1], 12))
    for m in range(q.shape[0]):
        k = base[min(m, base.shape[0] - 1)]
        link_motion(frames, JointMotion(q[m], dq[m], ddq[m]), k, motion)
        regressor(frames, q[m], motion, k, Y[m])


@jit
def wrench_torques(frames, q, wrenches, out):
    """Joint torques that wrenches on the last link make, Jᵀ [f; m].

    Args:
        frames: `Frames`; q: (m, n) rad.
        wrenches: (6, k) at the last link's origin, in axes of the base, one a column.
        out: (m, n, k), filled; zero for joints that do not carry the last link.
    """
    n = frames.parent.shape[0]
    R, o = np.empty((n, 3, 3)), np.empty((n, 3))
    axes, on_base = np.eye(3), np.empty(wrenches.shape)
    out[:] = 0.0
    for m in range(q.shape[0]):
        place_frames(frames, q[m], R, o)
        transfer_wrench(axes, o[n - 1], wrenches, on_base)
        j = n - 1
        while j >= 0:
            axis_moment(R[j], o[j], frames.slides[j], on_base, out[m, j])
            j = frames.parent[j]
