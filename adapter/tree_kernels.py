"""Regressor rows of a tree in compiled code, and their second moments.

Row j of `tau = Y theta` touches only the links beyond joint j, so each joint keeps the moments of
its own short row z_j = [y_j, tau_j]; weighted and added up they are the blocks of Yᵀ W Y, one for
each sub-tree that hangs on the base (60, 60 and 180 columns for the legs and the upper body of
ATLAS). Only the upper triangles are kept, one after the other in one flat array.

The base of a floating tree adds ten columns of its own, which only its six wrench rows see. The
moments of its columns, and those of the links that hang on it, with all of [Y tau] are enough to
fit these bodies to its wrench, given the others. (The links that hang on it have to take part:
what no torque shows of them can be counted to the base instead, and where too much was counted to
them, what is left for the base is no possible body.)

Every wrench is written in axes of the base and about its origin: then row j is the product of a
link's columns with the line of joint axis j, [o x z; z], and no column is carried up the tree.
"""

from __future__ import annotations

import math

import numpy as np

from adapter.fast import body_wrench_regressor, jit, link_motion


@jit
def place_frames(parent, R0, p, q, R, o):
    """Orientation R (n, 3, 3) and origin o (n, 3) of every link frame, in axes of the base."""
    for j in range(q.shape[0]):
        c, s = math.cos(q[j]), math.sin(q[j])
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
            o[j, r] = origin


@jit
def into_base(W, R, o, out):
    """out (6, 10): wrench columns W of a link placed at R (3, 3), o (3,), as wrenches on the base.

    As eq. 14a from the link right to the base.
    """
    for i in range(10):
        for h in (0, 3):
            x, y, z = W[h, i], W[h + 1, i], W[h + 2, i]
            for r in range(3):
                out[h + r, i] = R[r, 0] * x + R[r, 1] * y + R[r, 2] * z
    for i in range(10):
        fx, fy, fz = out[0, i], out[1, i], out[2, i]
        out[3, i] += o[1] * fz - o[2] * fy
        out[4, i] += o[2] * fx - o[0] * fz
        out[5, i] += o[0] * fy - o[1] * fx


@jit
def sample_rows(parent, slot, sizes, R0, p, q, dq, ddq, tau, base, rows, base_rows):
    """Fill the rows z_j = [y_j, tau_j] of one sample.

    Args:
        parent: (n,) int64, -1 for the base.
        slot: (n, n) int64, where in joint j's row the ten columns of link k start.
        sizes: (n,) columns of each joint's row; its torque sits behind them.
        q, dq, ddq: (n,); tau: (n,), or (6 + n,) with the base's wrench first.
        base: (12,) motion of the base.
        rows: (n, S + 1), filled.
        base_rows: (6, 10 (n + 1) + 1), filled: columns of the base, of the links, the wrench.
            (0, 0) where the base does not float.
    """
    n = q.shape[0]
    floating = base_rows.shape[0] == 6
    motion, R, o = np.empty((n, 12)), np.empty((n, 3, 3)), np.empty((n, 3))
    W, B = np.empty((6, 10)), np.empty((6, 10))
    link_motion(parent, R0, p, q, dq, ddq, base, motion)
    place_frames(parent, R0, p, q, R, o)
    first = tau.shape[0] - n
    if floating:
        body_wrench_regressor(base, W)
        base_rows[:, :10] = W
        base_rows[:, 10 * (n + 1)] = tau[:6]
    for k in range(n):
        rows[k, sizes[k]] = tau[first + k]
        body_wrench_regressor(motion[k], W)
        into_base(W, R[k], o[k], B)
        if floating:
            base_rows[:, 10 * (k + 1) : 10 * (k + 2)] = B
        j = k
        while j >= 0:
            zx, zy, zz = R[j, 0, 2], R[j, 1, 2], R[j, 2, 2]
            lx = o[j, 1] * zz - o[j, 2] * zy
            ly = o[j, 2] * zx - o[j, 0] * zz
            lz = o[j, 0] * zy - o[j, 1] * zx
            at = slot[j, k]
            for i in range(10):
                force = lx * B[0, i] + ly * B[1, i] + lz * B[2, i]
                rows[j, at + i] = force + zx * B[3, i] + zy * B[4, i] + zz * B[5, i]
            j = parent[j]


@jit
def accumulate(rows, sizes, starts, A):
    """Add z_j z_jᵀ of every joint to its upper triangle in the flat moments A."""
    for j in range(rows.shape[0]):
        at = starts[j]
        width = sizes[j] + 1
        for a in range(width):
            x = rows[j, a]
            if x != 0.0:
                triangle = A[at : at + width - a]
                z = rows[j, a:width]
                for b in range(width - a):
                    triangle[b] += x * z[b]
            at += width - a


@jit
def accumulate_base(base_rows, near, C):
    """C (2, K, 10 (n + 1) + 1) += columns `near`ᵀ [all columns, wrench]; forces, then moments.

    Args:
        near: (K,) columns of the base and of the links that hang on it.
    """
    for r in range(base_rows.shape[0]):
        z = base_rows[r]
        for a in range(near.shape[0]):
            x = z[near[a]]
            if x != 0.0:
                out = C[r // 3, a]
                for b in range(z.shape[0]):
                    out[b] += x * z[b]


@jit
def row_errors(th, place, sizes, rows, base_rows, error):
    """error (rows,): measured minus predicted torque; with a floating base its wrench first."""
    six = base_rows.shape[0]
    for r in range(six):
        columns = base_rows.shape[1] - 1
        e = base_rows[r, columns]
        for b in range(columns):
            e -= base_rows[r, b] * th[b]
        error[r] = e
    for j in range(rows.shape[0]):
        e = rows[j, sizes[j]]
        for k in range(sizes[j]):
            e -= rows[j, k] * th[place[j, k]]
        error[six + j] = e


@jit
def absorb(
    parent,
    slot,
    place,
    sizes,
    starts,
    near,
    R0,
    p,
    q,
    dq,
    ddq,
    tau,
    base,
    th,
    A,
    C,
    level,
    span,
    error,
):
    """Predict samples (m, ...) with th (P,), then add them to the moments A and C.

    Args:
        level: (rows,) running mean of squared errors, over `span` samples at most: (2,) samples
            seen, longest span. An empty `level` is left alone.
        A, C: an empty A leaves it at the prediction.
        error: (m, rows), filled with measured minus predicted torque.
    """
    n = parent.shape[0]
    rows = np.zeros((n, place.shape[1] + 1))
    base_rows = np.zeros((tau.shape[1] - n, 10 * (n + 1) + 1))
    for m in range(q.shape[0]):
        sample_rows(
            parent, slot, sizes, R0, p, q[m], dq[m], ddq[m], tau[m], base[m], rows, base_rows
        )
        row_errors(th, place, sizes, rows, base_rows, error[m])
        if A.shape[0] > 0:
            accumulate(rows, sizes, starts, A)
            accumulate_base(base_rows, near, C)
        if level.shape[0] > 0:
            span[0] = min(span[0] + 1.0, span[1])
            for r in range(level.shape[0]):
                level[r] += (error[m, r] * error[m, r] - level[r]) / span[0]
