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
