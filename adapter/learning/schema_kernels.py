"""Second moments of the body-schema signals, and the cost, gradient and curvature they hold.

For joint j with parent i, eqs. 8a, 8b and 8c multiplied by Rz(q_j) read `y = R0^T z`, with
`y` known from link j and `z = T(p) s` linear in known signals `s` of link i:

    channel 0 (angular velocity)      y = Rz(q)(w_j - dq z)   s = w_i
    channel 1 (linear velocity)       y = Rz(q) v_j           s = [v_i, w_i]
    channel 2 (linear acceleration)   y = Rz(q) a_j           s = [a_i, dw_i, products of w_i]

Of a joint that slides what its way q z along its own axis makes is known from link j alone, too:

    y = w_j    y = v_j - dq z - q w_j x z
    y = a_j - ddq z - 2 dq w_j x z - q (dw_j x z + w_j x (w_j x z))

so `sum |y - R0^T z|^2` over any number of samples depends on the data only through the second
moments of [y, s], 15 x 15 numbers at most per channel (reading notes). Small changes of a frame
are written (phi, d): R0 <- R0 exp(phi), p <- p + d.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array
from adapter.physics.kernels import Frames, borrowed, jit, link_spin
from adapter.signals.records import KIND, columns

# What a link measures, in the order of the moments (the online ones end with a), and the channel
# that has the same algebra.
CHANNELS = ("w", "v", "a", "dw")
KERNELS = (0, 1, 2, 0)
N_SIGNALS = (3, 6, 12)  # length of s by channel
WIDTH = 15  # y and the longest s
# Products of w in s of channel 2, which axes they multiply.
PRODUCTS = np.array([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])
NOISE_FLOOR = 1e-4  # m/s, rad/s, m/s²: below any sensor; keeps noise-free data from infinite weight
MISFIT_FLOOR = 1e-6  # share of a signal's power that no weight looks below while the fit is rough


class Count(IntEnum):
    """Places in `MotionMoments.counts`."""

    SAMPLES = 0  # in the moments (fewer where some were forgotten)
    DIFFERENCES = 1  # third differences taken
    UNBROKEN = 2  # motions since the last hole in time
    VELOCITIES = 3  # samples that showed a linear velocity of any body


class MotionMoments(NamedTuple):
    """All that λ is learned from, filled by `absorb`.

    Attributes:
        M: (n, 3, 15, 15) second moments of [y, s] by joint and channel.
        newest: the same of the last sample alone; (0, 3, 15, 15) where nobody asks for it.
        noise_power: (n + 1, 4) sums of squared third differences of v, w, a, dw of the base and
            of each link.
        last_motion: (3, n + 1, 12) the three motions before.
        last_stamps: (2,) int64 stamp of the last one, and the shortest step so far, ns.
        counts: (4,), see `Count`.
    """

    M: Array
    newest: Array
    noise_power: Array
    last_motion: Array
    last_stamps: NDArray[np.int64]
    counts: Array


def _placed() -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Row r, axis a and sign s (9, 2) of all that a frame's place p puts into T(p).

    The columns behind the first three, those of the three axes of w (or dw) and of the products,
    are `T[r, 3 + k] = s p[a]` in two places each: w x p, and w (w.p) - |w|^2 p.
    """
    found: list[list[tuple[int, int, float]]] = []
    for a, b in ((1, 2), (2, 0), (0, 1)):  # w_i p_a shows in row b with +, w_i p_b in row a with -
        found.append([(b, a, 1.0), (a, b, -1.0)])
    for a, b in PRODUCTS.tolist():
        others = [r for r in range(3) if r != a]
        same = [(r, r, -1.0) for r in others]
        found.append(same if a == b else [(a, b, 1.0), (b, a, 1.0)])
    table = np.array(found)
    rows, axes = table[:, :, 0].astype(np.int64), table[:, :, 1].astype(np.int64)
    return rows, axes, np.ascontiguousarray(table[:, :, 2])


ROWS, AXES, SIGNS = _placed()


@jit
def signals(slides, joint, parent_motion, motion, s):
    """Fill s (3, 15) with [y, s] of each channel for one joint at one instant.

    Args:
        slides: whether the joint slides; joint: its q, dq, ddq (ddq is used where it slides).
        parent_motion, motion: (12,) [v, w, a, dw] of link i and link j in their own frames.
    """
    q, dq, ddq = joint
    if slides:
        x, y, z = motion[3], motion[4], motion[5]
        s[0, 0], s[0, 1], s[0, 2] = x, y, z
        s[1, 0], s[1, 1], s[1, 2] = motion[0] - q * y, motion[1] + q * x, motion[2] - dq
        s[2, 0] = motion[6] - 2.0 * dq * y - q * (motion[10] + x * z)
        s[2, 1] = motion[7] + 2.0 * dq * x + q * (motion[9] - y * z)
        s[2, 2] = motion[8] - ddq + q * (x * x + y * y)
    else:
        c, sn = math.cos(q), math.sin(q)
        s[0, 0] = c * motion[3] - sn * motion[4]
        s[0, 1] = sn * motion[3] + c * motion[4]
        s[0, 2] = motion[5] - dq
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
def channel_cost(M, ch, R, p, g, H):
    """Sum of |y - R^T z|^2 of one channel; adds its gradient to g (6,), its curvature to H (6, 6).

    The gradient is that of half the sum, in (phi, d); the curvature is Gauss-Newton's, and left
    out where H is empty (0, 6).
    """
    k = N_SIGNALS[ch]
    work = np.zeros((9, k))
    T, TM, Tsy = work[:3], work[3:6], work[6:]
    for r in range(3):  # T begins with a unit matrix
        T[r, r] = 1.0
        for j in range(k):
            TM[r, j] = M[ch, 3 + r, 3 + j]  # sum z s^T
        for j in range(3):
            Tsy[r, j] = M[ch, 3 + r, j]  # sum z y^T
    for i in range(3, k):
        for e in range(2):
            r = ROWS[i - 3, e]
            t = SIGNS[i - 3, e] * p[AXES[i - 3, e]]
            T[r, i] = t
            for j in range(k):
                TM[r, j] += t * M[ch, 3 + i, 3 + j]
            for j in range(3):
                Tsy[r, j] += t * M[ch, 3 + i, j]
    cost = 0.0
    for r in range(3):  # u = R^T z
        uy = R[0, r] * Tsy[0, r] + R[1, r] * Tsy[1, r] + R[2, r] * Tsy[2, r]
        cost += M[ch, r, r] - 2.0 * uy
        for i in range(k):
            cost += TM[r, i] * T[r, i]
        g[0] += R[r, 1] * Tsy[r, 2] - R[r, 2] * Tsy[r, 1]
        g[1] += R[r, 2] * Tsy[r, 0] - R[r, 0] * Tsy[r, 2]
        g[2] += R[r, 0] * Tsy[r, 1] - R[r, 1] * Tsy[r, 0]
    for i in range(3, k):
        y = M[ch, 3 + i]
        for e in range(2):
            r = ROWS[i - 3, e]  # sum s_i (R y - z)_r
            left = R[r, 0] * y[0] + R[r, 1] * y[1] + R[r, 2] * y[2] - TM[r, i]
            g[3 + AXES[i - 3, e]] -= SIGNS[i - 3, e] * left
    if H.shape[0]:
        _add_curvature(M[ch], R, T, TM, H)
    return cost


@jit
def _add_curvature(M, R, T, TM, H):
    """Gauss-Newton's curvature (6, 6) of one channel in (phi, d), added to H."""
    k, trace = T.shape[1], 0.0
    for i in range(k):
        ux = R[0, 0] * TM[0, i] + R[1, 0] * TM[1, i] + R[2, 0] * TM[2, i]  # sum u s_i
        uy = R[0, 1] * TM[0, i] + R[1, 1] * TM[1, i] + R[2, 1] * TM[2, i]
        uz = R[0, 2] * TM[0, i] + R[1, 2] * TM[1, i] + R[2, 2] * TM[2, i]
        for b in range(3):  # sum u u^T
            v = R[0, b] * T[0, i] + R[1, b] * T[1, i] + R[2, b] * T[2, i]
            H[0, b] -= ux * v
            H[1, b] -= uy * v
            H[2, b] -= uz * v
            trace += (ux if b == 0 else (uy if b == 1 else uz)) * v
        if i < 3:
            continue
        for e in range(2):
            r, a, s = ROWS[i - 3, e], 3 + AXES[i - 3, e], SIGNS[i - 3, e]
            H[0, a] += s * (uz * R[r, 1] - uy * R[r, 2])
            H[1, a] += s * (ux * R[r, 2] - uz * R[r, 0])
            H[2, a] += s * (uy * R[r, 0] - ux * R[r, 1])
            for j in range(3, k):
                for f in range(2):
                    if ROWS[j - 3, f] == r:
                        H[a, 3 + AXES[j - 3, f]] += M[3 + i, 3 + j] * s * SIGNS[j - 3, f]
    for a in range(3):
        H[a, a] += trace
        for b in range(3):
            H[3 + b, a] = H[a, 3 + b]


@jit
def absorb(frames, base, table, moments, kind, each):
    """Add a table of filtered states to the moments.

    Args:
        frames: `Frames` as a plain tuple; where they are plays no part.
        base: (12,) motion of a base at rest; empty where the states hold the base's motion.
        table: (m, size) states, see `records.columns`; only those whose link motion is of this
            `kind` are taken.
        moments: `MotionMoments` as a plain tuple.
        each: forgetting factor of a sample, 1 for none, and its weight.
    """
    frames, table, moments = borrowed((frames, table, moments))
    parent, _, _, slides = frames
    into, (keep, weight) = MotionMoments(*moments), each
    n, counts = parent.shape[0], into.counts
    at = columns(n, base.shape[0] == 0)
    s, motion = np.zeros((3, 15)), np.zeros((n + 1, 12))
    motion[0, : base.shape[0]] = base
    for m in range(table.shape[0]):
        if table[m, KIND] != kind:
            continue
        if base.shape[0] == 0:
            motion[0] = table[m, at.base : at.bent]
        motion[1:] = table[m, at.motion : at.size].reshape((n, 12))
        if counts[Count.VELOCITIES] == 0.0 and motion[:, :3].any():
            counts[Count.VELOCITIES] = 1.0
        for j in range(n):
            q, dq = table[m, at.motion_q + j], table[m, at.motion_dq + j]
            joint = q, dq, table[m, at.ddq + j]
            signals(slides[j], joint, motion[parent[j] + 1], motion[j + 1], s)
            if weight != 1.0:
                s *= math.sqrt(weight)
            accumulate(s, keep, into.M[j])
            if counts[Count.VELOCITIES] == 0.0:
                # w alone would say that no frame has a place (v = w x p = 0)
                into.M[j, 1, 6:9, 6:9] = 0.0
            if into.newest.shape[0]:
                accumulate(s, 0.0, into.newest[j])
        counts[Count.SAMPLES] = keep * counts[Count.SAMPLES] + weight
        _look_for_noise(table[m, :1].view(np.int64)[0], motion, into)


@jit
def _look_for_noise(stamp, motion, into):
    """Take third differences of motion (n + 1, 12), which hold noise rather than motion."""
    counts, last, stamps = into.counts, into.last_motion, into.last_stamps
    step = stamp - stamps[0]
    stamps[0] = stamp
    stamps[1] = min(stamps[1], max(step, 1))
    if 2 * step > 5 * stamps[1]:
        counts[Count.UNBROKEN] = 0.0  # across a hole, motion would pass for noise
    if counts[Count.UNBROKEN] >= 3.0:
        counts[Count.DIFFERENCES] += 1.0
        for i in range(motion.shape[0]):
            for k in range(12):
                d = motion[i, k] - last[0, i, k] - 3.0 * (last[2, i, k] - last[1, i, k])
                into.noise_power[i, k // 3] += d * d / 3.0
    counts[Count.UNBROKEN] += 1.0
    for k in range(2):
        last[k] = last[k + 1]
    last[2] = motion


@jit
def carry_spin(frames, base, table):
    """Fill the links' angular accelerations by eq. 8d from the base's, w being as measured.

    Args:
        frames: `Frames` as a plain tuple; base, table: as for `absorb`.
    """
    tree = Frames(*frames)
    n = tree.parent.shape[0]
    at = columns(n, base.shape[0] == 0)
    for m in range(table.shape[0]):
        motion = table[m, at.motion : at.size].reshape((n, 12))
        for j in range(n):
            i, o = tree.parent[j], motion[j]
            if i >= 0:
                up = motion[i]
            elif base.shape[0]:
                up = base
            else:
                up = table[m, at.base : at.bent]
            q, dq = table[m, at.motion_q + j], table[m, at.motion_dq + j]
            rates = dq, table[m, at.ddq + j]
            if tree.slides[j]:
                q, rates = 0.0, (0.0, 0.0)
            cs = math.cos(q), math.sin(q)
            spin = (up[9], up[10], up[11])
            o[9], o[10], o[11] = link_spin(tree.R0[j], cs[0], cs[1], spin, (o[3], o[4]), rates)


@jit
def without_noise(parent, M, counts, variance, out):
    """out = M with the parents' noise variance (n + 1, 4; order v, w, a, dw) taken out.

    Where velocities are measured, angular accelerations and products of angular velocities leave
    altogether: what they show of a frame's place, the velocities show as well, and their noise
    cannot be told from jerky motion. Where none is (gyroscopes and accelerometers measure none),
    a frame's place shows in accelerations alone, and the noise in both is taken out.
    """
    count = counts[Count.SAMPLES]
    for j in range(parent.shape[0]):
        out[j] = M[j]
        noise = variance[parent[j] + 1]
        v, w, a, dw = noise[0], noise[1], noise[2], noise[3]
        for k in range(3):
            out[j, 0, 3 + k, 3 + k] -= count * w
            out[j, 1, 3 + k, 3 + k] -= count * v
            out[j, 1, 6 + k, 6 + k] -= count * w
            out[j, 2, 3 + k, 3 + k] -= count * a
        if counts[Count.VELOCITIES]:
            out[j, 2, 6:, :] = 0.0
            out[j, 2, :, 6:] = 0.0
            continue
        out[j, 1] = 0.0
        for k in range(3):
            out[j, 2, 6 + k, 6 + k] -= count * dw
        for k in range(6):
            x, y = PRODUCTS[k]
            square = M[j, 0, 3 + x, 3 + x] + M[j, 0, 3 + y, 3 + y]
            out[j, 2, 9 + k, 9 + k] -= w * (2.0 * square if x == y else square)


@jit
def profiled(frames, M, count, clean, g, H):
    """Gradient g (n, 6), every channel weighted by its own residual, and curvature H (n, 6, 6).

    Args:
        frames: `Frames` as a plain tuple; M: (n, 3, 15, 15) moments of `count` samples.
        clean: moments that the curvature is of, with the same weights; (0, 3, 15, 15): none asked.
    """
    frames, M, clean, g, H = borrowed((frames, M, clean, g, H))
    tree = Frames(*frames)
    gc, Hc, unused = np.empty(6), np.empty((6, 6)), np.zeros(6)
    for j in range(M.shape[0]):
        R, p = tree.R0[j], tree.p[j]
        g[j] = 0.0
        if clean.shape[0]:
            H[j] = 0.0
        for ch in range(3):
            gc[:] = 0.0
            cost = max(channel_cost(M[j], ch, R, p, gc, Hc[:0]), 0.0)
            power = M[j, ch, 0, 0] + M[j, ch, 1, 1] + M[j, ch, 2, 2]
            least = 3.0 * count * NOISE_FLOOR * NOISE_FLOOR + MISFIT_FLOOR * power
            weight = 3.0 * count / (cost + least + 1e-300)
            for a in range(6):
                g[j, a] += weight * gc[a]
            if clean.shape[0]:
                Hc[:] = 0.0
                channel_cost(clean[j], ch, R, p, unused, Hc)
                H[j] += weight * Hc


@jit
def residual_variance(frames, M, count, out):
    """out (n, 3): mean square of what each channel's fit leaves, per component."""
    tree = Frames(*frames)
    g, H = np.zeros(6), np.zeros((0, 6))
    for j in range(M.shape[0]):
        for ch in range(3):
            cost = channel_cost(M[j], ch, tree.R0[j], tree.p[j], g, H)
            out[j, ch] = max(cost, 0.0) / (3.0 * max(count, 1.0))


@jit
def steepest(frames, M, g):
    """Gradient g (n, 6) of the plain squared error (eq. 18)."""
    tree = Frames(*frames)
    none = np.zeros((0, 6))
    for j in range(M.shape[0]):
        g[j] = 0.0
        for ch in range(3):
            channel_cost(M[j], ch, tree.R0[j], tree.p[j], g[j], none)


@jit
def distances(inverse, count, g, out):
    """out (n, 2): longest entry of each joint's Newton step, rad or m, in the directions that are
    known and in those that are not yet (inverse (n, 2, 6, 6)); then g is put per sample."""
    for j in range(g.shape[0]):
        for k in range(2):
            out[j, k] = 0.0
            for a in range(6):
                out[j, k] = max(out[j, k], abs(_row_times(inverse[j, k], a, g[j])))
    g /= max(count, 1.0)


@jit
def _row_times(A, a, x):
    """Row a of A x for A (6, 6); so small a product is faster than a library's."""
    total = 0.0
    for b in range(6):
        total += A[a, b] * x[b]
    return total


@jit
def descend(frames, M, count, inverse, g, out):
    """`profiled` without curvature, then `distances`, in one call for the 1 kHz step."""
    profiled(frames, M, count, M[:0], g, inverse[:, 0])  # no curvature: nothing is written there
    distances(inverse, count, g, out)


@jit
def retract(frames, step, project, distance, pace):
    """Move every frame by its projected step (n, 6): R0 exp(phi), p + d; then zero the step.

    Args:
        frames: `Frames` as a plain tuple, moved.
        project: (n, 2, 6, 6) onto directions that may move, known ones and others.
        distance: (n, 2) of each joint to its optimum in them.
        pace: (longest, share, rate): a step taken at `rate` is scaled to `longest`, or to a share
            of the joint's distance. In directions that noise still hides the distance is large; it
            may not set the pace in those that are known.
    """
    tree = Frames(*frames)
    (longest, share, rate), x = pace, np.empty(6)
    for j in range(step.shape[0]):
        x[:] = 0.0
        for k in range(2):
            if distance[j, k] > 0.0:
                size = min(longest, share * distance[j, k]) / rate
                for a in range(6):
                    x[a] += size * _row_times(project[j, k], a, step[j])
        move(tree, j, x)
    step[:] = 0.0


@jit
def moved(frames, R0, p, out):
    """Fill out (n, 6) with small turns and shifts from R0 (n, 3, 3), p (n, 3) to the frames.

    Sines of the turns, which is all that is asked for a hundred times a second; inf for more than
    a quarter turn.
    """
    tree, turn = Frames(*frames), np.empty((3, 3))
    for j in range(p.shape[0]):
        for a in range(3):
            for b in range(3):
                turn[a, b] = 0.0
                for r in range(3):
                    turn[a, b] += R0[j, r, a] * tree.R0[j, r, b]
        far = turn[0, 0] + turn[1, 1] + turn[2, 2] < 1.0
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            out[j, k] = np.inf if far else 0.5 * (turn[b, a] - turn[a, b])
            out[j, 3 + k] = tree.p[j, k] - p[j, k]


@jit
def strayed(frames, R0, p, allowed):
    """Whether any frame has moved from R0 (n, 3, 3), p (n, 3) by more than (n, 6), see `moved`."""
    by = np.empty(allowed.shape)
    moved(frames, R0, p, by)
    return (np.abs(by) > allowed).any()


@jit
def move(tree, j, x):
    """Move frame j by x (6,) in its own axes: R0 exp(phi), p + d."""
    turn = np.empty((3, 3))
    angle = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    s = np.sin(angle) / angle if angle > 1e-8 else 1.0
    h = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-8 else 0.5
    for r in range(3):
        for c in range(3):
            turn[r, c] = h * x[r] * x[c]
        turn[r, r] += 1.0 - h * angle * angle
    turn[0, 1] -= s * x[2]
    turn[0, 2] += s * x[1]
    turn[1, 0] += s * x[2]
    turn[1, 2] -= s * x[0]
    turn[2, 0] -= s * x[1]
    turn[2, 1] += s * x[0]
    for r in range(3):
        a, b, c = tree.R0[j, r, 0], tree.R0[j, r, 1], tree.R0[j, r, 2]
        for k in range(3):
            tree.R0[j, r, k] = a * turn[0, k] + b * turn[1, k] + c * turn[2, k]
        tree.p[j, r] += x[3 + r]


@jit
def directions(curvature, limits, goals, g, out):
    """Which directions the data show, how many of them are known, and how far their optimum is.

    Args:
        curvature: eigenvalues (n, 6) and eigenvectors (n, 6, 6), in columns.
        limits: curvature above which a direction is shown, and known.
        goals: rad and m that may be left where λ has arrived; standard deviations that may be, in
            directions that are known, and in those that are not yet.
        g: (n, 6) gradient.
        out: projectors and inverse curvature (n, 2, 6, 6), on directions that are known and on
            those that are not yet; (n, 6) left to go; (n,) known directions; (n,) whether λ has
            arrived. All are filled.

    Returns:
        How many directions are shown.
    """
    (values, vectors), (least, enough) = curvature, limits
    project, inverse, left, ranks, there = out
    shown, ahead = 0, np.empty(6)
    for j in range(g.shape[0]):
        project[j], inverse[j], left[j], ranks[j], there[j] = 0.0, 0.0, 0.0, 0, True
        for i in range(6):
            value, v = values[j, i], vectors[j, :, i]
            if not value > least:
                continue
            known = value > enough
            k = 0 if known else 1
            shown += 1
            ranks[j] += known
            for a in range(6):
                for b in range(6):
                    project[j, k, a, b] += v[a] * v[b]
                    inverse[j, k, a, b] += v[a] * v[b] / value
        for k in range(2):
            for a in range(6):
                ahead[a] = _row_times(inverse[j, k], a, g[j])
                most = max(goals[0], goals[1 + k] * math.sqrt(inverse[j, k, a, a]))
                there[j] = there[j] and abs(ahead[a]) < most
                left[j, a] += ahead[a]
    return shown


@jit
def finish(frames, left, near, g):
    """Move every frame that has less than `near` left (n, 6) to go there; then its g is zero."""
    tree = Frames(*frames)
    for j in range(left.shape[0]):
        if np.abs(left[j]).max() < near:
            move(tree, j, -left[j])
            g[j] = 0.0
