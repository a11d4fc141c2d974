"""Second moments of the body-schema signals, and the cost, gradient and curvature they hold.

For joint j with parent i, eqs. 8a, 8b and 8c multiplied by Rz(q_j) read `y = R0^T z`, with
`y` known from link j and `z = T(p) s` linear in known signals `s` of link i:

    channel 0 (angular velocity)      y = Rz(q)(w_j - dq z)   s = w_i
    channel 1 (linear velocity)       y = Rz(q) v_j           s = [v_i, w_i]
    channel 2 (linear acceleration)   y = Rz(q) a_j           s = [a_i, dw_i, products of w_i]

so `sum |y - R0^T z|^2` over any number of samples depends on the data only through the second
moments of [y, s], 15 x 15 numbers at most per channel (reading notes). Small changes of a frame
are written (phi, d): R0 <- R0 exp(phi), p <- p + d.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from adapter.fast import jit

N_SIGNALS = (3, 6, 12)  # length of s by channel
WIDTH = 15  # y and the longest s


def _placement_derivatives() -> NDArray[np.float64]:
    """D[c, i] (3, 3): T(p)[:, i] = T(0)[:, i] + D[c, i] p."""
    D = np.zeros((3, 12, 3, 3))
    cross = np.zeros((3, 3, 3))  # column i of w x p, by component of w
    for i, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        cross[i, b, a] = 1.0  # w_i p_a shows in row b with +, w_i p_b in row a with -
        cross[i, a, b] = -1.0
    D[1, 3:6] = cross
    D[2, 3:6] = cross
    # w (w.p) - |w|^2 p for the products xx xy xz yy yz zz
    for i, (a, b) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        D[2, 6 + i, a, b] += 1.0
        if a == b:
            D[2, 6 + i] -= np.eye(3)
        else:
            D[2, 6 + i, b, a] += 1.0
    return D


DERIVATIVES = _placement_derivatives()


@jit
def signals(q, dq, parent_motion, motion, s):
    """Fill s (3, 15) with [y, s] of each channel for one joint at one instant.

    Args:
        q, dq: position and velocity of the joint, rad, rad/s.
        parent_motion, motion: (12,) [v, w, a, dw] of link i and link j in their own frames.
    """
    c, sn = math.cos(q), math.sin(q)
    wz = motion[5] - dq
    s[0, 0] = c * motion[3] - sn * motion[4]
    s[0, 1] = sn * motion[3] + c * motion[4]
    s[0, 2] = wz
    for ch, o in ((1, 0), (2, 6)):
        s[ch, 0] = c * motion[o] - sn * motion[o + 1]
        s[ch, 1] = sn * motion[o] + c * motion[o + 1]
        s[ch, 2] = motion[o + 2]
    wx, wy, wz = parent_motion[3], parent_motion[4], parent_motion[5]
    for k in range(3):
        s[0, 3 + k] = parent_motion[3 + k]
        s[1, 3 + k] = parent_motion[k]
        s[1, 6 + k] = parent_motion[3 + k]
        s[2, 3 + k] = parent_motion[6 + k]
        s[2, 6 + k] = parent_motion[9 + k]
    s[2, 9], s[2, 10], s[2, 11] = wx * wx, wx * wy, wx * wz
    s[2, 12], s[2, 13], s[2, 14] = wy * wy, wy * wz, wz * wz


@jit
def accumulate(s, keep, M):
    """M (3, 15, 15) <- keep M + s s^T by channel; keep < 1 forgets exponentially."""
    for ch in range(3):
        k = 6 if ch == 0 else (9 if ch == 1 else 15)
        for a in range(k):
            x = s[ch, a]
            for b in range(k):
                M[ch, a, b] = keep * M[ch, a, b] + x * s[ch, b]


@jit
def channel_cost(M, D, ch, R, p, curved, g, H):
    """Sum of |y - R^T z|^2 of one channel; adds its gradient to g (6,) and, if `curved`, its
    curvature to H (6, 6).

    The gradient is that of half the sum, in (phi, d); the curvature is Gauss-Newton's.
    """
    k = 3 if ch == 0 else (6 if ch == 1 else 12)
    T = np.zeros((3, k))
    for i in range(k):
        for r in range(3):
            T[r, i] = 1.0 if i == r else 0.0
            for a in range(3):
                T[r, i] += D[ch, i, r, a] * p[a]
    TM = np.zeros((3, k))  # sum z s^T
    Tsy = np.zeros((3, 3))  # sum z y^T
    for r in range(3):
        for i in range(k):
            t = T[r, i]
            if t != 0.0:
                for j in range(k):
                    TM[r, j] += t * M[ch, 3 + i, 3 + j]
                for j in range(3):
                    Tsy[r, j] += t * M[ch, 3 + i, j]
    Suy = R.T @ Tsy  # sum u y^T with u = R^T z
    cost = 0.0
    for r in range(3):
        cost += M[ch, r, r] - 2.0 * Suy[r, r]
        for i in range(k):
            cost += TM[r, i] * T[r, i]
    g[0] += Suy[1, 2] - Suy[2, 1]
    g[1] += Suy[2, 0] - Suy[0, 2]
    g[2] += Suy[0, 1] - Suy[1, 0]
    for i in range(3, k):
        for r in range(3):
            e = -TM[r, i]  # sum s_i (R y - z)_r
            for a in range(3):
                e += R[r, a] * M[ch, 3 + i, a]
            for a in range(3):
                g[3 + a] -= D[ch, i, r, a] * e
    if curved:
        _add_curvature(M, D, ch, k, R, T, TM, H)
    return cost


@jit
def _add_curvature(M, D, ch, k, R, T, TM, H):
    """Gauss-Newton's curvature (6, 6) of one channel in (phi, d), added to H."""
    U = R.T @ TM  # sum u s^T
    Suu = U @ T.T @ R
    trace = Suu[0, 0] + Suu[1, 1] + Suu[2, 2]
    for a in range(3):
        for b in range(3):
            H[a, b] -= Suu[a, b]
        H[a, a] += trace
    for i in range(3, k):
        for a in range(3):  # H_phi,d += [U_i]x^T (R^T D_i)
            x, y, z = U[0, i], U[1, i], U[2, i]
            v0, v1, v2 = 0.0, 0.0, 0.0
            for r in range(3):
                d = D[ch, i, r, a]
                v0 += R[r, 0] * d
                v1 += R[r, 1] * d
                v2 += R[r, 2] * d
            H[0, 3 + a] += z * v1 - y * v2
            H[1, 3 + a] += x * v2 - z * v0
            H[2, 3 + a] += y * v0 - x * v1
        for j in range(3, k):
            m = M[ch, 3 + i, 3 + j]
            for a in range(3):
                for b in range(3):
                    x = D[ch, i, 0, a] * D[ch, j, 0, b] + D[ch, i, 1, a] * D[ch, j, 1, b]
                    H[3 + a, 3 + b] += m * (x + D[ch, i, 2, a] * D[ch, j, 2, b])
    for a in range(3):
        for b in range(3):
            H[3 + b, a] = H[a, 3 + b]


@jit
def absorb(
    parent,
    base,
    stamps,
    kinds,
    q,
    dq,
    motion,
    kind,
    keep,
    M,
    newest,
    noise_power,
    last_motion,
    last_stamps,
    counts,
):
    """Add a table of samples to the moments.

    Args:
        kinds: (m,) kind of link motion of each sample; only `kind` is taken.
        q, dq: (m, n); motion: (m, n, 12); base: (12,).
        M: (n, 3, 15, 15) moments; newest: (n, 3, 15, 15) those of the last sample alone.
        noise_power: (n, 3) sum of squared third differences of v, w, a of each link.
        last_motion: (3, n, 12) the three motions before.
        last_stamps: (2,) int64 stamp of the last one, and the shortest step so far, ns.
        counts: (3,) samples in the moments, third differences taken, motions since a hole.
    """
    n = parent.shape[0]
    s = np.zeros((3, 15))
    for m in range(kinds.shape[0]):
        if kinds[m] != kind:
            continue
        for j in range(n):
            up = base if parent[j] < 0 else motion[m, parent[j]]
            signals(q[m, j], dq[m, j], up, motion[m, j], s)
            accumulate(s, keep, M[j])
            accumulate(s, 0.0, newest[j])
        counts[0] = keep * counts[0] + 1.0
        step = stamps[m] - last_stamps[0]
        last_stamps[0] = stamps[m]
        last_stamps[1] = min(last_stamps[1], max(step, 1))
        if 2 * step > 5 * last_stamps[1]:
            counts[2] = 0.0  # across a hole, motion would pass for noise
        if counts[2] >= 3.0:
            counts[1] += 1.0
            for j in range(n):
                for k in range(9):
                    d = motion[m, j, k] - last_motion[0, j, k]
                    d -= 3.0 * (last_motion[2, j, k] - last_motion[1, j, k])
                    noise_power[j, k // 3] += d * d / 3.0
        counts[2] += 1.0
        for k in range(2):
            last_motion[k] = last_motion[k + 1]
        last_motion[2] = motion[m]


@jit
def without_noise(parent, M, count, variance, out):
    """out = M with the parents' noise variance (n, 3; order v, w, a) taken out.

    Angular accelerations and products of angular velocities leave altogether: what they show of
    a frame's place, the twists show as well, and their noise cannot be told from jerky motion.
    """
    for j in range(parent.shape[0]):
        out[j] = M[j]
        i = parent[j]
        if i < 0:
            continue
        for a in range(3):
            out[j, 0, 3 + a, 3 + a] -= count * variance[i, 1]
            out[j, 1, 3 + a, 3 + a] -= count * variance[i, 0]
            out[j, 1, 6 + a, 6 + a] -= count * variance[i, 1]
            out[j, 2, 3 + a, 3 + a] -= count * variance[i, 2]
        out[j, 2, 6:, :] = 0.0
        out[j, 2, :, 6:] = 0.0


@jit
def profiled(M, clean, count, D, R0, p, floor, misfit, curved, g, H):
    """Gradient g (n, 6), every channel weighted by its own residual.

    If `curved`, also the curvature H (n, 6, 6) that the moments `clean` have with these weights.
    """
    gc, Hc, unused = np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    for j in range(R0.shape[0]):
        g[j] = 0.0
        if curved:
            H[j] = 0.0
        for ch in range(3):
            gc[:], Hc[:] = 0.0, 0.0
            cost = max(channel_cost(M[j], D, ch, R0[j], p[j], False, gc, Hc), 0.0)
            power = M[j, ch, 0, 0] + M[j, ch, 1, 1] + M[j, ch, 2, 2]
            weight = 3.0 * count / (cost + 3.0 * count * floor * floor + misfit * power + 1e-300)
            for a in range(6):
                g[j, a] += weight * gc[a]
            if curved:
                channel_cost(clean[j], D, ch, R0[j], p[j], True, unused, Hc)
                H[j] += weight * Hc


@jit
def residual_variance(M, count, D, R0, p, out):
    """out (n, 3): mean square of what each channel's fit leaves, per component."""
    g, H = np.zeros(6), np.zeros((6, 6))
    for j in range(R0.shape[0]):
        for ch in range(3):
            cost = channel_cost(M[j], D, ch, R0[j], p[j], False, g, H)
            out[j, ch] = max(cost, 0.0) / (3.0 * max(count, 1.0))


@jit
def steepest(M, D, R0, p, g, H):
    """Gradient g (n, 6) of the plain squared error (eq. 18)."""
    for j in range(R0.shape[0]):
        g[j] = 0.0
        for ch in range(3):
            channel_cost(M[j], D, ch, R0[j], p[j], False, g[j], H[j])


@jit
def distances(inverse, count, g, out):
    """out (n,): longest entry of each joint's Newton step, rad or m; then g is put per sample."""
    for j in range(g.shape[0]):
        out[j] = np.abs(inverse[j] @ g[j]).max()
    g /= max(count, 1.0)


@jit
def descend(M, count, D, R0, p, floor, misfit, inverse, g, H, out):
    """`profiled` without curvature, then `distances`, in one call for the 1 kHz step."""
    profiled(M, M, count, D, R0, p, floor, misfit, False, g, H)
    distances(inverse, count, g, out)


@jit
def retract(step, distance, longest, share, rate, project, R0, p):
    """Move every frame by its projected step (n, 6): R0 exp(phi), p + d; then zero the step.

    A step taken at `rate` is scaled to `longest`, or to a share of the joint's distance (n,).
    """
    turn = np.empty((3, 3))
    for j in range(R0.shape[0]):
        scale = min(longest, share * distance[j]) / rate
        x = scale * (project[j] @ step[j])
        a = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
        s = np.sin(a) / a if a > 1e-8 else 1.0
        h = (1.0 - np.cos(a)) / (a * a) if a > 1e-8 else 0.5
        for r in range(3):
            for c in range(3):
                turn[r, c] = h * x[r] * x[c]
            turn[r, r] += 1.0 - h * a * a
        turn[0, 1] -= s * x[2]
        turn[0, 2] += s * x[1]
        turn[1, 0] += s * x[2]
        turn[1, 2] -= s * x[0]
        turn[2, 0] -= s * x[1]
        turn[2, 1] += s * x[0]
        R0[j] = R0[j] @ turn
        p[j] += x[3:]
    step[:] = 0.0
