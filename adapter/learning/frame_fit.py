"""One joint frame from its moments in closed form: where λ may start, and where it ends.

The cost of a rotation has saddle points half a turn away from its minimum, and with the position
beside it other valleys: there ADAM stands still at the wrong frame. The moments tell, since a
closed form on them needs no start (`SchemaCheck`).

The moments may hold three channels (the online learner's w, v, a) or four (with dw, in batch):
those that are there are used. Changes of a frame are (turn, shift), turns in the frame's own axes,
R0 <- R0 exp(turn), p <- p + shift, as `schema_kernels` has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from adapter.learning.schema_kernels import (
    KERNELS,
    MISFIT_FLOOR,
    N_SIGNALS,
    NOISE_FLOOR,
    channel_cost,
)
from adapter.model.spatial import Array, exp_rotation
from adapter.physics.freedom import Freedom

# Eigenvalues of the curvature below this, relative to the largest, are rounding.
RELATIVE_CURVATURE = 1e-10
STEPS = 60  # of Gauss-Newton; from Wahba's rotation 4 are enough, from a far start 20
SMALLEST_STEP = 1e-13  # rad, m: close to the rounding of a frame
LONGEST_TURN = 1.0  # rad a step
SAME_COST = 1e-9  # costs this close, relative to the signals' power, can't be told apart
# Logarithms of what frames leave unexplained, summed over the channels.
CLEARLY_BETTER = 0.5
AGAIN = 2.0  # a joint is checked again when there are so many times the samples
LOOKS = 20  # until a joint's turn comes again


@dataclass
class Frame:
    """A joint frame in its parent at q = 0: R0 (3, 3), p (3,)."""

    R0: Array
    p: Array

    def moved(self, step: Array) -> Frame:
        """The frame after (turn, shift) in its own axes (6,); p stays in the parent's."""
        return Frame(self.R0 @ exp_rotation(step[:3]), self.p + step[3:])

    def distance(self, other: Frame) -> float:
        """Turn (rad, by its chord) and shift (m) to another frame, as one length."""
        chord = 0.5 * np.sum((self.R0 - other.R0) ** 2)
        return float(np.sqrt(chord + np.sum((self.p - other.p) ** 2)))


def channel_costs(sums: Array, frame: Frame) -> Array:
    """Sum of squared residuals (c,) of each channel of one joint; not below zero."""
    unused = np.zeros(6), np.zeros((0, 6))
    costs = [_channel(sums, c, frame, *unused) for c in range(len(sums))]
    return np.maximum(costs, 0.0)


def slope_and_curvature(sums: Array, weights: Array, frame: Frame) -> tuple[float, Array, Array]:
    """Weighted cost, the gradient (6,) of half of it, and Gauss-Newton's curvature (6, 6)."""
    cost, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
    for c in np.flatnonzero(weights):
        g, h = np.zeros(6), np.zeros((6, 6))
        cost += weights[c] * _channel(sums, int(c), frame, g, h)
        gradient += weights[c] * g
        curvature += weights[c] * h
    return cost, gradient, curvature


def _channel(sums: Array, c: int, frame: Frame, g: Array, h: Array) -> float:
    """`schema_kernels.channel_cost` of a channel here, which may be the algebra of another."""
    kernel = KERNELS[c]
    moments = sums[c - kernel :]  # the kernel looks at place `kernel` of what it is given
    return float(channel_cost(moments, kernel, frame.R0, frame.p, g, h))


def profiled_weights(sums: Array, count: float, frame: Frame) -> Array:
    """Weights (c,) of the channels by what the frame leaves of each, as the learner has them."""
    _, least = _powers(sums, count)
    return np.asarray(3.0 * count / (channel_costs(sums, frame) + least))


def log_misfit(sums: Array, count: float, frame: Frame) -> float:
    """Logarithm of the share of each channel that a frame leaves unexplained, summed over them.

    None below `MISFIT_FLOOR` of a channel's power.
    """
    power, least = _powers(sums, count)
    return float(np.log((channel_costs(sums, frame) + least) / (power + least)).sum())


def _powers(sums: Array, count: float) -> tuple[Array, Array]:
    """Sum of |y|² of each channel, and the least misfit that is looked at."""
    power = np.trace(sums[:, :3, :3], axis1=1, axis2=2)
    return power, 3.0 * count * NOISE_FLOOR**2 + MISFIT_FLOOR * power + 1e-300


def weighted_power(sums: Array, weights: Array) -> float:
    """Weighted sum of |y|² over the channels of one joint."""
    return float(weights @ np.trace(sums[:, :3, :3], axis1=1, axis2=2))


def descend(
    sums: Array, weights: Array, start: Frame, freedom: Freedom | None = None
) -> tuple[Frame, float]:
    """Gauss-Newton to the nearest minimum of the weighted cost; what is not shown stays.

    Args:
        sums: (c, 15, 15) moments of one joint; weights: (c,) of its channels.
        freedom: what counts as not shown; None: what is rounding in the curvature.

    Returns:
        The frame and its cost.
    """
    frame = start
    cost, gradient, curvature = slope_and_curvature(sums, weights, frame)
    # Close to a minimum without noise the cost is the rounding of large sums and judges no step.
    rounding = 1e-12 * weighted_power(sums, weights)  # of a cost, relative to the signals' power
    for _ in range(STEPS):
        step = _newton_step(frame, gradient, curvature, freedom)
        for _ in range(12):
            trial = frame.moved(step)
            found = slope_and_curvature(sums, weights, trial)
            if found[0] <= cost + rounding:
                break
            step = 0.5 * step
        else:
            break
        frame, (cost, gradient, curvature) = trial, found
        if np.abs(step).max(initial=0.0) < SMALLEST_STEP:
            break
    return frame, cost


def _newton_step(frame: Frame, gradient: Array, curvature: Array, freedom: Freedom | None) -> Array:
    """Gauss-Newton's (6,) in the shown directions, no longer than `LONGEST_TURN`."""
    basis = np.eye(6)
    if freedom is not None:
        values, vectors = np.linalg.eigh(freedom.hidden(frame.p[None])[0])
        basis = vectors[:, values < 0.5]
        basis[:3] = frame.R0.T @ basis[:3]
    values, vectors = np.linalg.eigh(basis.T @ curvature @ basis)
    kept = values > RELATIVE_CURVATURE * max(float(values.max(initial=0.0)), 0.0)
    shown = basis @ vectors[:, kept]
    step = -shown @ ((shown.T @ gradient) / values[kept])
    return np.asarray(step * min(1.0, LONGEST_TURN / max(float(np.linalg.norm(step[:3])), 1e-300)))


def first_frames(sums: Array, weights: Array, prior: Frame) -> list[Frame]:
    """Where to start: Wahba's rotation, with several turns where it leaves one open."""
    u, values, vt = np.linalg.svd(_wahba(sums, weights))
    best = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    if values[0] == 0.0:
        return [prior]
    # Singular values of Wahba's matrix below this, relative to the largest: what shows no more than
    # one direction leaves the turn about it open.
    if values[1] > 1e-3 * values[0]:
        return [Frame(best, prior.p.copy())]
    about = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)[:, None] * u[:, 0]  # tried about it
    return [Frame(turn @ best, prior.p.copy()) for turn in exp_rotation(about)]


def _wahba(sums: Array, weights: Array) -> Array:
    """Sum of z y^T (3, 3) over the channels, weighted, with what depends on p taken out.

    y = R0^T (z + L(p)) with L linear in further signals: what y and z have left once these are
    fitted to them is turned into one another by R0^T, wherever the frame is.
    """
    total = np.zeros((3, 3))
    for c in np.flatnonzero(weights):
        size = N_SIGNALS[KERNELS[c]]
        rest = slice(6, 3 + size)
        M = sums[c]
        left = M[3:6, :3]
        if size > 3:
            fit = np.linalg.pinv(M[rest, rest], rcond=RELATIVE_CURVATURE, hermitian=True)
            left = left - M[3:6, rest] @ fit @ M[rest, :3]
        total += weights[c] * left
    return total


def best_frame(sums: Array, weights: Array, prior: Frame) -> tuple[Frame, float]:
    """The frame of lowest cost, and its cost; of equal ones the nearest to the prior."""
    found = [descend(sums, weights, start) for start in first_frames(sums, weights, prior)]
    good = min(cost for _, cost in found) + SAME_COST * weighted_power(sums, weights)
    return min((x for x in found if x[1] <= good), key=lambda x: x[0].distance(prior))


def curvature_in_parent(sums: Array, weights: Array, frame: Frame) -> tuple[Array, Array]:
    """Eigenvalues (6,) and eigenvectors (6, 6), in columns, by [turn; shift] in parent's axes."""
    _, _, own = slope_and_curvature(sums, weights, frame)
    turn = np.eye(6)
    turn[:3, :3] = frame.R0
    values, vectors = np.linalg.eigh(turn @ own @ turn.T)
    return values, vectors


def nearest(sums: Array, weights: Array, frame: Frame, to: Frame, freedom: Freedom) -> Frame:
    """Of the frames that explain the data as this one does, the nearest to another.

    Along the freedom it is a closed form; the data say the rest. The freedom is as exact as the
    data, so both are repeated until nothing moves.
    """
    for _ in range(STEPS):
        before = frame
        moved = freedom.nearest(frame.R0[None], frame.p[None], to.R0[None], to.p[None])
        frame, _ = descend(sums, weights, Frame(moved[0][0], moved[1][0]), freedom)
        if frame.distance(before) < SMALLEST_STEP:
            break
    return frame


class Evidence(NamedTuple):
    """What is known of one joint.

    Attributes:
        sums, clean: (3, 15, 15) moments of so many samples, and what of them is motion.
        rank: directions known. least: curvature above which a direction follows the data.
        still: whether ADAM has arrived where the gradient leads it.
    """

    sums: Array
    clean: Array
    samples: float
    rank: int
    least: float
    still: bool


class SchemaCheck:
    """Looks at every joint once in so many looks, and rarely solves for one.

    Args:
        n: joints.

    Attributes:
        misfit: (n,) what each frame left unexplained when it was last looked at.
        passed_at, passed_rank: (n,) samples and directions shown when it was last found right.
        turn: the number of the next look.
        restarts: joints that were started anew so far.
    """

    def __init__(self, n: int) -> None:
        self.misfit = np.full(n, np.inf)
        self.passed_at, self.passed_rank = np.zeros(n), np.full(n, -1)
        self.turn = self.restarts = 0

    def next_joints(self, ranks: np.ndarray | None) -> list[int]:
        """The joints that this look is at.

        Args:
            ranks: (n,) directions shown where λ stands still, waiting for its check alone: then a
                joint that has not been found right with them comes out of turn.
        """
        joints = list(range(self.turn, len(self.misfit), LOOKS))
        self.turn = (self.turn + 1) % LOOKS
        if ranks is not None:
            joints += [int(j) for j in np.flatnonzero(self.passed_rank != ranks)[:1]]
        return joints

    def better(self, j: int, frame: Frame, start: Frame, known: Evidence) -> Frame | None:
        """Where joint j is to start anew; None where it is right, or still on its way.

        Args:
            frame: where it stands; start: where it stays in what the data do not show.
        """
        misfit, before = log_misfit(known.sums, known.samples, frame), self.misfit[j]
        self.misfit[j] = misfit
        due = known.rank != self.passed_rank[j] or known.samples > AGAIN * self.passed_at[j]
        if not due or (misfit < before - 0.2 and not known.still):  # ADAM is on its way
            return None
        found = self._solved(frame, start, known, misfit)
        self.passed_at[j], self.passed_rank[j] = known.samples, known.rank
        if found is not None:
            self.misfit[j] = log_misfit(known.sums, known.samples, found)
            self.restarts += 1
        return found

    @staticmethod
    def _solved(frame: Frame, start: Frame, known: Evidence, misfit: float) -> Frame | None:
        """The closed form's frame where it is clearly better."""
        sums, count = known.sums, known.samples
        found, _ = best_frame(sums, profiled_weights(sums, count, frame), frame)
        weights = profiled_weights(sums, count, found)
        found, _ = descend(sums, weights, found)
        if log_misfit(sums, count, found) > misfit - CLEARLY_BETTER:
            return None
        weights = profiled_weights(sums, count, found)
        values, vectors = curvature_in_parent(known.clean, weights, found)
        hidden = vectors[:, values <= known.least]  # what the data do not show
        freedom = Freedom.of((hidden @ hidden.T)[None], found.p[None])
        held = nearest(sums, weights, found, start, freedom)
        return held if log_misfit(sums, count, held) < misfit - CLEARLY_BETTER else found
