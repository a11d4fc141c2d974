"""Second moments of torque and regressor, and the gradient they hold in log-Cholesky parameters.

Row j of `tau = Y theta + effects` touches only the links beyond joint j and joint j's effects,
so each joint keeps the moments of its own short row z_j = [y_j, tau_j]: eq. 19 for joint j over
any number of samples is `x^T A x` in them, with x = [theta, -1]. Only the upper triangles are
kept, one after the other in one flat array.

A floating base adds ten columns of its own, which only its six wrench rows see. The moments of
its columns, and of those of the links that hang on it, with all of [Y tau] are enough to fit these
bodies to its wrench, given the others. (The links that hang on it have to take part: what no
torque shows of them can be counted to the base instead, and where too much was counted to them,
what is left for the base is no possible body.)

Parameters come as one flat vector: ten log-Cholesky numbers per body, then the effects. Bodies
are the base if it floats, the links in order, and one spare body that takes the place of the hand
after a change there.

Kernels take records of arrays as plain tuples and name them inside: named ones take numba 3 µs
longer to receive.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.by_joint import SMOOTHING_DQ
from adapter.model.spatial import Array
from adapter.physics.kernels import (
    Frames,
    JointMotion,
    axis_moment,
    body_wrench_regressor,
    borrowed,
    jit,
    link_motion,
    place_frames,
    transfer_wrench,
)
from adapter.signals.records import columns

# Prior on the second-moment radii of a body, exp(d): log-normal around 0.1 m. Without it a body
# that the data hardly show would run to the edge of what is possible and take long to come back.
LOG_RADIUS, LOG_RADIUS_STD = math.log(0.1), 2.0
TOGETHER = 4  # samples whose rows are added to the moments in one pass

Indices = NDArray[np.int64]


class Rows(NamedTuple):
    """Which parameters the torque rows touch.

    Attributes:
        slot: (n, n) where in joint j's row the ten columns of link k start, -1 where k is not
            beyond j.
        sizes: (n,) columns of each joint's row, its effects last; its torque sits behind them.
        starts: (n,) where its triangle starts in the flat moments.
        place: (n, S) which parameter each column belongs to; several columns have one parameter
            where they stand for an effect of several shapes.
        share: (n, S) how far the parameter acts through the column.
        base_place: (10 (n + 1),) the same for the rows of the base's wrench: base, links.
        near: (K,) columns of these that have moments, the base's ten first.
        steps: (P - 10 bodies,) of the effects' parameters, what ADAM takes for one.
    """

    slot: Indices
    sizes: Indices
    starts: Indices
    place: Indices
    share: Array
    base_place: Indices
    near: Indices
    steps: Array


class Given(NamedTuple):
    """What a prediction needs besides states.

    Attributes:
        base: (12,) motion of a base at rest; empty where the states hold the base's motion.
        tool: (10,) of a known tool on the hand; its torque is taken off first.
        hand: (1,) the link that carries it.
        th: (P,) θ and effects.
    """

    base: Array
    tool: Array
    hand: Indices
    th: Array


class Moments(NamedTuple):
    """What `absorb` fills; empty arrays are left alone.

    Attributes:
        A: flat upper triangles of z zᵀ of each joint.
        C: (2, K, 10 (n + 1) + 1) columns `near`ᵀ [all columns, wrench] of the rows of the base's
            force, then of its moment.
        base_level: (6,) running mean of the squared prediction errors of the base's wrench.
        span: (2,) samples that it has seen, and at most how many it spans.
        counts: (n,) samples of each joint's torque, rests at their weight.
    """

    A: Array
    C: Array
    base_level: Array
    span: Array
    counts: Array


class Prior(NamedTuple):
    """What is known besides the moments.

    Attributes:
        H, rhs: information (P, P) and right side (P,) of a Gaussian on θ and effects.
        ranges: (P, 2) first column of each row of H that is not zero, and the one behind the last.
        radius: weight of the prior on each body's radii.
    """

    H: Array
    rhs: Array
    ranges: Indices
    radius: float


class Weighing(NamedTuple):
    """How the moments count.

    Attributes:
        counts: (n,) samples of each joint's torque in them.
        noise_gain: correlated samples that one independent sample is worth.
        floor: (n,) variance that `floor_count` samples would have shown before.
        error: variance that the model is not trusted to explain, (N m)².
        base: (2,) weight of the base's force and moment rows.
        share: (K,) how far the base's rows count for each of their columns `near`.
    """

    counts: Array
    noise_gain: float
    floor: Array
    floor_count: float
    error: float
    base: Array
    share: Array


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
def values(x, steps, th):
    """theta and effects, th (P,), of the flat parameters x (P,)."""
    U = np.empty((4, 4))
    effects = x.shape[0] - steps.shape[0]
    for b in range(effects // 10):
        body_from_log_cholesky(x[10 * b : 10 * b + 10], U, th[10 * b : 10 * b + 10])
    th[effects:] = steps * x[effects:]


@jit
def follow(x, span, steps, mean, th):
    """Carry the running mean (P,) over `span` iterates along with x; th (P,) are its values."""
    for i in range(x.shape[0]):
        mean[i] += (x[i] - mean[i]) / span
    values(mean, steps, th)


@jit
def sample_rows(frames, rows, given, state, effects, into):
    """Fill the rows z of one sample; returns nothing.

    Args:
        frames: `Frames`; rows: `Rows`; given: `Given`.
        state: (size,) or its part up to the base's motion.
        effects: (e, n) value of each effect's column at each joint.
        into: z (n, S + 1) of the joints, and (6, 10 (n + 1) + 1) of the base's wrench ((0, ...)
            where it does not float).
    """
    z, base_z = into
    n, six, links = z.shape[0], base_z.shape[0], 10 * (z.shape[0] + 1)
    at = columns(n, six > 0)
    base = state[at.base : at.bent] if six else given.base
    q = state[at.q : at.dq]
    motion, R, o = np.empty((n, 12)), np.empty((n, 3, 3)), np.empty((n, 3))
    W, B = np.empty((6, 10)), np.empty((6, 10))
    link_motion(frames, JointMotion(q, state[at.dq : at.ddq], state[at.ddq : at.tau]), base, motion)
    place_frames(frames, q, R, o)
    if six:
        body_wrench_regressor(base, W)
        base_z[:, :10] = W
        base_z[:, links] = state[at.tau : at.tau + 6]
    for k in range(n):
        size = rows.sizes[k]
        z[k, size] = state[at.tau + six + k]
        for e in range(effects.shape[0]):
            z[k, size - effects.shape[0] + e] = effects[e, k]
        body_wrench_regressor(motion[k], W)
        transfer_wrench(R[k], o[k], W, B)
        if six:
            base_z[:, 10 * (k + 1) : 10 * (k + 2)] = B
        j = k
        while j >= 0:
            s = rows.slot[j, k]
            axis_moment(R[j], o[j], frames.slides[j], B, z[j, s : s + 10])
            j = frames.parent[j]
    _take_tool_off(frames.parent, rows, given, into)


@jit
def _take_tool_off(parent, rows, given, into):
    """Subtract the torque of a known tool on the hand from the measured one."""
    z, base_z = into
    hand, links = given.hand[0], 10 * (z.shape[0] + 1)
    for k in range(10):
        t = given.tool[k]
        if t == 0.0:
            continue
        j = hand
        while j >= 0:
            z[j, rows.sizes[j]] -= z[j, rows.slot[j, hand] + k] * t
            j = parent[j]
        for r in range(base_z.shape[0]):
            base_z[r, links] -= base_z[r, 10 * (hand + 1) + k] * t


@jit
def row_errors(rows, th, z, base_z, error):
    """error (rows,): measured minus predicted torque; with a floating base its wrench first."""
    six = base_z.shape[0]
    for r in range(six):
        e = base_z[r, base_z.shape[1] - 1]
        for b in range(base_z.shape[1] - 1):
            e -= base_z[r, b] * th[rows.base_place[b]]
        error[r] = e
    for j in range(z.shape[0]):
        t = 0.0
        for k in range(rows.sizes[j]):
            t += z[j, k] * rows.share[j, k] * th[rows.place[j, k]]
        error[six + j] = z[j, rows.sizes[j]] - t


@jit
def accumulate(rows, z, A):
    """Add z_j z_jᵀ of every joint, for samples z (k, n, S + 1), to its triangle in A.

    Four samples at a time: a triangle is read and written once for all of them.
    """
    m = z.shape[0]
    fours = m // TOGETHER * TOGETHER
    for j in range(z.shape[1]):
        at, width = rows.starts[j], rows.sizes[j] + 1
        for k in range(0, fours, TOGETHER):
            _add_four(A, at, z[k, j, :width], z[k + 1, j], z[k + 2, j], z[k + 3, j])
        for k in range(fours, m):
            _add_one(A, at, z[k, j, :width])


@jit
def _add_four(A, at, z0, z1, z2, z3):
    """Add z zᵀ of four rows, z0 (w,) and others at least as long, to the triangle from `at` on."""
    for a in range(z0.shape[0]):
        b0, b1, b2, b3 = z0[a:], z1[a:], z2[a:], z3[a:]
        triangle, x0, x1, x2, x3 = A[at : at + b0.shape[0]], z0[a], z1[a], z2[a], z3[a]
        for b in range(b0.shape[0]):
            triangle[b] += x0 * b0[b] + x1 * b1[b] + x2 * b2[b] + x3 * b3[b]
        at += b0.shape[0]


@jit
def _add_one(A, at, z):
    """Add z zᵀ of one row z (w,) to the triangle from `at` on."""
    for a in range(z.shape[0]):
        rest, x = z[a:], z[a]
        triangle = A[at : at + rest.shape[0]]
        for b in range(rest.shape[0]):
            triangle[b] += x * rest[b]
        at += rest.shape[0]


@jit
def accumulate_base(near, z, C):
    """Add columns `near`ᵀ [all columns, wrench] of one sample's rows z (6, ...) to C."""
    for h in range(C.shape[0]):
        z0, z1, z2 = z[3 * h], z[3 * h + 1], z[3 * h + 2]
        for a in range(near.shape[0]):
            x0, x1, x2 = z0[near[a]], z1[near[a]], z2[near[a]]
            out = C[h, a]
            for b in range(out.shape[0]):
                out[b] += x0 * z0[b] + x1 * z1[b] + x2 * z2[b]


@partial(jit, sums_in_any_order=True)
def times_moments(A, at, t, v):
    """v = A t for the symmetric matrix whose upper triangle starts at `at` in the flat A."""
    width = t.shape[0]
    v[:] = 0.0
    for a in range(width):
        size, ta = width - a, t[a]
        triangle, tb, vb = A[at : at + size], t[a:], v[a:]
        total = triangle[0] * ta
        for b in range(1, size):
            vb[b] += triangle[b] * ta
            total += triangle[b] * tb[b]
        v[a] += total
        at += size


@jit
def forget_along(rows, z, rate, A):
    """Forget, in A, only along the direction of the newest rows z (Cao, Schwartz 2000).

    A loses `rate` of what it knows about z and nothing else, so directions that are not excited
    keep what was learned, however long that lasts.
    """
    v = np.empty(z.shape[1])
    for j in range(z.shape[0]):
        at, width = rows.starts[j], rows.sizes[j] + 1
        zj, Az = z[j, :width], v[:width]
        times_moments(A, at, zj, Az)
        zAz = 0.0
        for a in range(width):
            zAz += zj[a] * Az[a]
        if zAz > 1e-12:
            for a in range(width):
                x = rate * Az[a] / zAz
                for b in range(a, width):
                    A[at] -= x * Az[b]
                    at += 1


@jit
def absorb(frames, rows, given, table, effects, moments):
    """Predict every sample, then add it to the moments; returns the errors.

    Args:
        frames, rows, given, moments: `Frames`, `Rows`, `Given`, and `Moments` with a rate of
            directional forgetting per sample (0 for none), the weight of a sample and (n,) what is
            left of it of a joint at rest, as plain tuples.
        table: (m, size) states, or their part up to the base's motion.
        effects: (m, e, n) columns of the effects.

    Returns:
        (m, rows) measured minus predicted torque; the base's wrench first if it floats.
    """
    frames, rows, given, moments, table = borrowed((frames, rows, given, moments, table))
    tree, at, use = Frames(*frames), Rows(*rows), Given(*given)
    into, rate, weight, rests = Moments(*moments[0]), moments[1], moments[2], moments[3]
    m, n = table.shape[0], tree.parent.shape[0]
    six = 0 if use.base.shape[0] else 6
    dq = columns(n, six > 0).dq
    error = np.empty((m, six + n))
    z = np.zeros((min(m, TOGETHER), n, at.place.shape[1] + 1))
    base_z = np.zeros((six, 10 * (n + 1) + 1))
    for k in range(m):
        own = z[k % TOGETHER]
        sample_rows(tree, at, use, table[k], effects[k], (own, base_z))
        row_errors(at, use.th, own, base_z, error[k])
        if weight != 1.0:
            base_z *= math.sqrt(weight)
        for j in range(n):
            moves = abs(table[k, dq + j]) > SMOOTHING_DQ
            counts = weight if moves else weight * rests[j]
            if counts != 1.0:
                own[j] *= math.sqrt(counts)
            if into.counts.shape[0]:
                into.counts[j] += counts
        if into.A.shape[0]:
            if rate > 0.0:
                forget_along(at, own, rate, into.A)
                into.C[:] *= 1.0 - rate
                accumulate(at, z[k % TOGETHER : k % TOGETHER + 1], into.A)
            elif k == m - 1 or k % TOGETHER == TOGETHER - 1:
                accumulate(at, z[: k % TOGETHER + 1], into.A)
            accumulate_base(at.near, base_z, into.C)
        if into.base_level.shape[0]:
            into.span[0] = min(into.span[0] + weight, into.span[1])
            for r in range(six):
                square = error[k, r] * error[k, r]
                into.base_level[r] += weight * (square - into.base_level[r]) / into.span[0]
    return error


@jit
def joint_costs(rows, th, A):
    """(n,) sum of squared torque errors of each joint over all samples in A."""
    at, A = Rows(*borrowed(rows)), borrowed(A)
    n, width = at.place.shape
    cost, v, t = np.empty(n), np.empty(width + 1), np.empty(width + 1)
    for j in range(n):
        cost[j] = _times_row(at, j, th, A, t, v)
    return cost


@jit
def _times_row(rows, j, th, A, t, v):
    """Fill t with [th of joint j's row, -1] and v with A t; the cost tᵀ A t, at least 0."""
    s = rows.sizes[j]
    for k in range(s):
        t[k] = rows.share[j, k] * th[rows.place[j, k]]
    t[s] = -1.0
    times_moments(A, rows.starts[j], t[: s + 1], v[: s + 1])
    cost = 0.0
    for k in range(s + 1):
        cost += t[k] * v[k]
    return max(cost, 0.0)


@jit
def unfolded(A, start, width):
    """(width, width) of the symmetric matrix whose upper triangle starts there in the flat A."""
    out, k = np.empty((width, width)), start
    for a in range(width):
        for b in range(a, width):
            out[a, b] = out[b, a] = A[k]
            k += 1
    return out


@jit
def add_information(rows, A, weights, H, rhs):
    """Add what joints' torques in A tell, a sample of each weighing so much (n,), to H and rhs.

    Args:
        rows: `Rows` as a plain tuple; H (P, P), rhs (P,): of the parameters.
    """
    at = Rows(*rows)
    for j in range(at.sizes.shape[0]):
        s, k = at.sizes[j], at.starts[j]
        for a in range(s):
            i, x = at.place[j, a], weights[j] * at.share[j, a]
            for b in range(a, s):
                o, value = at.place[j, b], x * at.share[j, b] * A[k]
                H[i, o] += value
                if a != b:
                    H[o, i] += value
                k += 1
            rhs[i] += x * A[k]
            k += 1


@jit
def add_joint_slopes(rows, A, weighing, th, g):
    """Add the gradient by th (P,) of half the weighted torque cost to g (P,).

    Each joint is weighted by 1 / (noise_gain * variance), the variance being its own residual
    one plus the model's error: the noise level is profiled, not assumed.
    """
    n, width = rows.place.shape
    t, v = np.empty(width + 1), np.empty(width + 1)
    w = weighing
    for j in range(n):
        cost = _times_row(rows, j, th, A, t, v)
        variance = (cost + w.floor_count * w.floor[j]) / (w.counts[j] + w.floor_count)
        weight = 1.0 / (w.noise_gain * (variance + w.error))
        for k in range(rows.sizes[j]):
            g[rows.place[j, k]] += weight * rows.share[j, k] * v[k]


@jit
def add_base_slopes(rows, C, weighing, th, g):
    """Add the gradient, by the parameters `near`, of half the base's weighted wrench cost to g."""
    for h in range(C.shape[0]):
        for a in range(rows.near.shape[0]):
            out = C[h, a]
            d = -out[out.shape[0] - 1]
            for b in range(out.shape[0] - 1):
                d += out[b] * th[rows.base_place[b]]
            share = weighing.share[a] * weighing.base[h]
            g[rows.base_place[rows.near[a]]] += share * d


@jit
def gradient(x, rows, moments, prior, weighing, out):
    """Gradient of half the weighted cost by the flat parameters x (P,), over the sample count.

    Args:
        rows, prior, weighing: `Rows`, `Prior`, `Weighing` as plain tuples.
        moments: A and C of `Moments`.
        out: th, g, gx (P,), filled with the values, the gradient by them and that by x.
    """
    x, rows, moments, prior, out = borrowed((x, rows, moments, prior, out))
    at, before, weigh = Rows(*rows), Prior(*prior), Weighing(*weighing)
    A, C = moments
    th, g, gx = out
    effects = x.shape[0] - at.steps.shape[0]
    values(x, at.steps, th)
    for a in range(x.shape[0]):
        d = -before.rhs[a]
        for b in range(before.ranges[a, 0], before.ranges[a, 1]):
            d += before.H[a, b] * th[b]
        g[a] = d
    add_joint_slopes(at, A, weigh, th, g)
    add_base_slopes(at, C, weigh, th, g)
    U = np.empty((4, 4))
    body = np.empty(10)
    for b in range(effects // 10):
        body_from_log_cholesky(x[10 * b : 10 * b + 10], U, body)
        pull_back(U, g[10 * b : 10 * b + 10], gx[10 * b : 10 * b + 10])
        for i in range(1, 4):
            away = x[10 * b + i] - LOG_RADIUS
            gx[10 * b + i] += before.radius * away / LOG_RADIUS_STD**2
    gx[effects:] = at.steps * g[effects:]
    gx *= 1.0 / max(weigh.counts.max(), 1.0)
