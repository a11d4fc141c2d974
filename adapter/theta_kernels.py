"""Second moments of torque and regressor, and the gradient they hold in log-Cholesky parameters.

Row j of `tau = Y theta + effects` touches only the links beyond joint j and joint j's effects,
so each joint keeps the moments of its own short row [y, tau] (size S_j + 1): eq. 19 for joint j
over any number of samples is `x^T A x - 2 b^T x + c` in them.

Parameters come as one flat vector: ten log-Cholesky numbers per body, then the effects. Bodies
are the links in order, then one spare body that takes the last link's place after a change.
"""

from __future__ import annotations

import math

import numpy as np

from adapter.fast import jit, link_motion, regressor

# Prior on the second-moment radii of a body, exp(d): log-normal around 0.1 m. Without it a body
# that the data hardly show would run to the edge of what is possible and take long to come back.
LOG_RADIUS, LOG_RADIUS_STD = math.log(0.1), 2.0


@jit
def body_from_log_cholesky(x, U, th):
    """theta (10,) and the factor U (4, 4) of the pseudo-inertia U U^T (Rucker, Wensing 2022)."""
    scale = math.exp(x[0])
    U[:] = 0.0
    for i in range(3):
        U[i, i] = scale * math.exp(x[1 + i])
        U[i, 3] = scale * x[7 + i]
    U[3, 3] = scale
    U[0, 1], U[1, 2], U[0, 2] = scale * x[4], scale * x[5], scale * x[6]
    sxx = U[0, 0] ** 2 + U[0, 1] ** 2 + U[0, 2] ** 2 + U[0, 3] ** 2
    syy = U[1, 1] ** 2 + U[1, 2] ** 2 + U[1, 3] ** 2
    szz = U[2, 2] ** 2 + U[2, 3] ** 2
    th[0] = U[3, 3] ** 2
    for i in range(3):
        th[1 + i] = U[i, 3] * U[3, 3]
    th[4], th[7], th[9] = syy + szz, sxx + szz, sxx + syy
    th[5] = -(U[0, 1] * U[1, 1] + U[0, 2] * U[1, 2] + U[0, 3] * U[1, 3])
    th[6] = -(U[0, 2] * U[2, 2] + U[0, 3] * U[2, 3])
    th[8] = -(U[1, 2] * U[2, 2] + U[1, 3] * U[2, 3])


@jit
def pull_back(U, g, gx):
    """Gradient gx (10,) by the log-Cholesky parameters from g (10,) by theta."""
    G = np.empty((4, 4))
    G[3, 3] = 2.0 * g[0]
    for i in range(3):
        G[i, 3] = G[3, i] = g[1 + i]
    G[0, 0], G[1, 1], G[2, 2] = 2 * (g[7] + g[9]), 2 * (g[4] + g[9]), 2 * (g[4] + g[7])
    G[0, 1] = G[1, 0] = -g[5]
    G[0, 2] = G[2, 0] = -g[6]
    G[1, 2] = G[2, 1] = -g[8]
    total = 0.0
    for i in range(4):
        for j in range(i, 4):
            d = 0.0
            for k in range(j + 1):
                d += G[i, k] * U[k, j]
            total += d * U[i, j]
            if i == j and i < 3:
                gx[1 + i] = d * U[i, i]
            elif j == 3 and i < 3:
                gx[7 + i] = d * U[3, 3]
            elif i == 0 and j == 1:
                gx[4] = d * U[3, 3]
            elif i == 1 and j == 2:
                gx[5] = d * U[3, 3]
            elif i == 0 and j == 2:
                gx[6] = d * U[3, 3]
    gx[0] = total


@jit
def values(x, bodies, th):
    """theta and effects, th (P,), of the flat parameters x (P,)."""
    U = np.empty((4, 4))
    for b in range(bodies):
        body_from_log_cholesky(x[10 * b : 10 * b + 10], U, th[10 * b : 10 * b + 10])
    th[10 * bodies :] = x[10 * bodies :]


@jit
def follow(x, span, bodies, mean, th):
    """Carry the running mean (P,) over `span` iterates along with x; th (P,) are its values."""
    for i in range(x.shape[0]):
        mean[i] += (x[i] - mean[i]) / span
    values(mean, bodies, th)


@jit
def model_rows(parent, R0, p, q, dq, ddq, base, effect_columns, motion, Y, support, sizes, rows):
    """Fill rows (n, S) with each joint's regressor row over its support; returns nothing.

    Args:
        effect_columns: (e, n) value of each effect's column at each joint.
        support: (n, S) indices into the flat parameters, the links' columns first; `sizes` (n, 2)
            how many are columns of links and how many there are in all.
        motion (n, 12), Y (n, 10 n): work space.
    """
    link_motion(parent, R0, p, q, dq, ddq, base, motion)
    regressor(parent, R0, p, q, motion, Y)
    for j in range(q.shape[0]):
        links, size = sizes[j, 0], sizes[j, 1]
        for k in range(links):
            rows[j, k] = Y[j, support[j, k]]
        for k in range(links, size):
            rows[j, k] = effect_columns[k - links, j]


@jit
def predict(th, place, sizes, rows, tau):
    """tau (n,) of the parameters th (P,); `place` (n, S) says where in th each column finds it."""
    for j in range(rows.shape[0]):
        t = 0.0
        for k in range(sizes[j, 1]):
            t += rows[j, k] * th[place[j, k]]
        tau[j] = t


@jit
def accumulate(rows, tau, sizes, A):
    """A (n, S+1, S+1) += [y, tau] [y, tau]^T for each joint; tau sits at index S_j."""
    for j in range(rows.shape[0]):
        s = sizes[j, 1]
        z = rows[j]
        for a in range(s):
            x = z[a]
            if x != 0.0:
                for b in range(s):
                    A[j, a, b] += x * z[b]
                A[j, a, s] += x * tau[j]
                A[j, s, a] += x * tau[j]
        A[j, s, s] += tau[j] * tau[j]


@jit
def forget_along(rows, tau, sizes, rate, A):
    """Forget, in A, only along the direction of the newest row (Cao, Schwartz 2000).

    A loses `rate` of what it knows about [y, tau] and nothing else, so directions that are not
    excited keep what was learned, however long that lasts.
    """
    for j in range(rows.shape[0]):
        s = sizes[j, 1]
        Az = np.zeros(s + 1)
        zAz = 0.0
        for a in range(s + 1):
            za = tau[j] if a == s else rows[j, a]
            for b in range(s + 1):
                Az[a] += A[j, a, b] * (tau[j] if b == s else rows[j, b])
            zAz += za * Az[a]
        if zAz > 1e-12:
            for a in range(s + 1):
                for b in range(s + 1):
                    A[j, a, b] -= rate * Az[a] * Az[b] / zAz


@jit
def joint_costs(th, A, sizes, place, cost):
    """cost (n,): sum of squared torque errors of each joint over all samples in A."""
    for j in range(A.shape[0]):
        s = sizes[j, 1]
        c = A[j, s, s]
        for a in range(s):
            ta = th[place[j, a]]
            d = -2.0 * A[j, a, s]
            for b in range(s):
                d += A[j, a, b] * th[place[j, b]]
            c += ta * d
        cost[j] = max(c, 0.0)


@jit
def gradient(
    x,
    bodies,
    A,
    sizes,
    place,
    count,
    noise_gain,
    floor,
    floor_count,
    error,
    prior,
    prior_rhs,
    radius_weight,
    th,
    g,
    gx,
):
    """Gradient gx (P,) of half the weighted cost by the flat parameters, over the sample count.

    Each joint is weighted by 1 / (noise_gain * variance), the variance being its own residual
    one (`cost / count`, with `floor_count` samples of variance `floor` (n,) as a prior) plus
    `error`: the noise level is profiled, not assumed. th and g are filled with the values and
    the gradient by them.
    """
    values(x, bodies, th)
    P = th.shape[0]
    for a in range(P):
        d = -prior_rhs[a]
        for b in range(P):
            d += prior[a, b] * th[b]
        g[a] = d
    n = A.shape[0]
    for j in range(n):
        s = sizes[j, 1]
        t = np.empty(s)
        d = np.empty(s)
        for a in range(s):
            t[a] = th[place[j, a]]
        cost = A[j, s, s]
        for a in range(s):
            v = 0.0
            for b in range(s):
                v += A[j, a, b] * t[b]
            d[a] = v - A[j, a, s]
            cost += t[a] * (v - 2.0 * A[j, a, s])
        variance = (max(cost, 0.0) + floor_count * floor[j]) / (count + floor_count)
        weight = 1.0 / (noise_gain * (variance + error))
        for a in range(s):
            g[place[j, a]] += weight * d[a]
    U = np.empty((4, 4))
    out = np.empty(10)
    scale = 1.0 / max(count, 1.0)
    for b in range(bodies):
        body_from_log_cholesky(x[10 * b : 10 * b + 10], U, out)
        pull_back(U, g[10 * b : 10 * b + 10], gx[10 * b : 10 * b + 10])
        for i in range(1, 4):
            away = x[10 * b + i] - LOG_RADIUS
            gx[10 * b + i] += radius_weight * away / LOG_RADIUS_STD**2
    gx[10 * bodies :] = g[10 * bodies :]
    gx *= scale


@jit
def absorb(
    parent,
    R0,
    p,
    base,
    q,
    dq,
    ddq,
    tau,
    columns,
    tool,
    support,
    sizes,
    place,
    th,
    rate,
    A,
    newest,
    error,
):
    """Predict every sample with th, then add it to the moments A (n, S+1, S+1).

    Args:
        q, dq, ddq, tau: (m, n); columns: (m, e, n) of the effects; error: (m, n), filled with
            measured minus predicted torque.
        tool: (10,) of a known tool on the last link; its torque is taken off first.
        rate: of directional forgetting per sample, 0 for none.
        newest: (n, S+1, S+1) moments of the last sample alone.
    """
    n = parent.shape[0]
    motion, Y = np.empty((n, 12)), np.empty((n, 10 * n))
    rows, expected, own = np.zeros((n, support.shape[1])), np.empty(n), np.empty(n)
    for m in range(q.shape[0]):
        model_rows(
            parent, R0, p, q[m], dq[m], ddq[m], base, columns[m], motion, Y, support, sizes, rows
        )
        for j in range(n):
            own[j] = tau[m, j]
            for k in range(10):
                own[j] -= Y[j, 10 * (n - 1) + k] * tool[k]
        predict(th, place, sizes, rows, expected)
        error[m] = own - expected
        if rate > 0.0:
            forget_along(rows, own, sizes, rate, A)
        accumulate(rows, own, sizes, A)
    if newest.shape[0] > 0 and q.shape[0] > 0:
        newest[:] = 0.0
        accumulate(rows, own, sizes, newest)
