"""Gradient by log-Cholesky parameters that the moments of `tree_kernels` hold, compiled."""

from __future__ import annotations

import numpy as np

from adapter.fast import jit
from adapter.theta_kernels import LOG_RADIUS, LOG_RADIUS_STD, body_from_log_cholesky, pull_back


@jit
def times_moments(A, at, t, v):
    """v = A t for the symmetric matrix whose upper triangle starts at `at` in the flat A."""
    width = t.shape[0]
    v[:] = 0.0
    for a in range(width):
        ta = t[a]
        size = width - a
        triangle, tb, vb = A[at : at + size], t[a:], v[a:]
        s0, s1, s2, s3 = triangle[0] * ta, 0.0, 0.0, 0.0
        for b in range(1, size):
            vb[b] += triangle[b] * ta
        rest = 1 + (size - 1) // 4 * 4
        for b in range(1, rest, 4):  # four sums side by side: one would wait for itself
            s0 += triangle[b] * tb[b]
            s1 += triangle[b + 1] * tb[b + 1]
            s2 += triangle[b + 2] * tb[b + 2]
            s3 += triangle[b + 3] * tb[b + 3]
        for b in range(rest, size):
            s0 += triangle[b] * tb[b]
        v[a] += (s0 + s1) + (s2 + s3)
        at += size


@jit
def joint_slopes(th, place, sizes, starts, A, count, noise_gain, floor, variance, g):
    """Add the gradient by θ of half the weighted torque cost to g (P,).

    variance (n,) is filled: each joint's own residual variance plus `floor`; its weight is
    1 / (noise_gain * variance), so the noise level is profiled, not assumed.
    """
    n = sizes.shape[0]
    t, v = np.empty(place.shape[1] + 1), np.empty(place.shape[1] + 1)
    for j in range(n):
        s = sizes[j]
        for k in range(s):
            t[k] = th[place[j, k]]
        t[s] = -1.0
        times_moments(A, starts[j], t[: s + 1], v[: s + 1])
        cost = 0.0
        for k in range(s + 1):
            cost += t[k] * v[k]
        variance[j] = max(cost, 0.0) / max(count, 1.0) + floor
        weight = 1.0 / (noise_gain * variance[j])
        for k in range(s):
            g[place[j, k]] += weight * v[k]


@jit
def base_slopes(th, near, share, C, weights, g):
    """Add the gradient by the parameters `near` of half the base's weighted wrench cost to g.

    Each counts by its `share` (K,).
    """
    for h in range(C.shape[0]):
        for a in range(near.shape[0]):
            d = -C[h, a, th.shape[0]]
            for b in range(th.shape[0]):
                d += C[h, a, b] * th[b]
            g[near[a]] += share[a] * weights[h] * d


@jit
def gradient(
    x,
    place,
    sizes,
    starts,
    near,
    share,
    A,
    C,
    count,
    noise_gain,
    floor,
    base_weights,
    prior,
    prior_mean,
    th,
    g,
    variance,
    gx,
):
    """Gradient gx (P,) of half the weighted cost by log-Cholesky parameters x, per sample.

    Args:
        base_weights: (2,) 1 / variance of the base's force and moment rows.
        prior, prior_mean: (P,) information and centre of the prior on θ.
        th, g: (P,), filled with θ and the gradient by θ; variance: (n,), see `joint_slopes`.
    """
    bodies = x.shape[0] // 10
    U = np.empty((4, 4))
    for b in range(bodies):
        body_from_log_cholesky(x[10 * b : 10 * b + 10], U, th[10 * b : 10 * b + 10])
    for a in range(x.shape[0]):
        g[a] = prior[a] * (th[a] - prior_mean[a])
    joint_slopes(th, place, sizes, starts, A, count, noise_gain, floor, variance, g)
    base_slopes(th, near, share, C, base_weights, g)
    out = np.empty(10)
    scale = 1.0 / max(count, 1.0)
    for b in range(bodies):
        body_from_log_cholesky(x[10 * b : 10 * b + 10], U, out)
        pull_back(U, g[10 * b : 10 * b + 10], gx[10 * b : 10 * b + 10])
        for i in range(1, 4):
            gx[10 * b + i] += (x[10 * b + i] - LOG_RADIUS) / LOG_RADIUS_STD**2
    for a in range(x.shape[0]):
        gx[a] *= scale
