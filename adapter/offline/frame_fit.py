"""Where one joint's frame is: Gauss-Newton on its moments, from where Wahba's problem says.

Changes of a frame are (turn, shift) in the frame's own axes, R0 <- R0 exp(turn), p <- p + shift,
as `schema_kernels` has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from adapter.offline.moments import CHANNELS, KERNELS
from adapter.schema_kernels import DERIVATIVES, channel_cost
from adapter.spatial import Array, exp_rotation, log_rotation

# Eigenvalues of the curvature below this, relative to the largest, are rounding.
RELATIVE_CURVATURE = 1e-10
# Singular values of sum z y^T below this, relative to the largest: turns about one axis alone,
# which leave the rotation open.
OPEN_ROTATION = 1e-3
STEPS = 60  # of Gauss-Newton; from Wahba's rotation 4 are enough, from a far start 20
SMALLEST_STEP = 1e-13  # rad, m: close to the rounding of a frame
LONGEST_TURN = 1.0  # rad a step
HALVINGS = 12
COST_ROUNDING = 1e-12  # of a cost, relative to the signals' power
SAME_COST = 1e-9  # costs this close, relative to the signals' power, can't be told apart


@dataclass
class Frame:
    """A joint frame in its parent at q = 0: R0 (3, 3), p (3,)."""

    R0: Array
    p: Array

    def moved(self, step: Array) -> Frame:
        """The frame after (turn, shift) in its own axes (6,); p stays in the parent's."""
        return Frame(self.R0 @ exp_rotation(step[:3]), self.p + step[3:])

    def offset_to(self, other: Frame) -> Array:
        """(turn, shift) that lead to another frame."""
        return np.r_[log_rotation(self.R0.T @ other.R0), other.p - self.p]


def channel_costs(sums: Array, frame: Frame) -> Array:
    """Sum of squared residuals (4,) of each channel of one joint; not below zero."""
    unused = np.zeros(6), np.zeros((6, 6))
    costs = [_channel(sums, c, frame, False, *unused) for c in range(len(CHANNELS))]
    return np.maximum(costs, 0.0)


def slope_and_curvature(sums: Array, weights: Array, frame: Frame) -> tuple[float, Array, Array]:
    """Weighted cost, the gradient (6,) of half of it, and Gauss-Newton's curvature (6, 6)."""
    cost, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
    for c in np.flatnonzero(weights):
        g, h = np.zeros(6), np.zeros((6, 6))
        cost += weights[c] * _channel(sums, int(c), frame, True, g, h)
        gradient += weights[c] * g
        curvature += weights[c] * h
    return cost, gradient, curvature


def _channel(sums: Array, c: int, frame: Frame, curved: bool, g: Array, h: Array) -> float:
    """`schema_kernels.channel_cost` of a channel here, which may be the algebra of another."""
    kernel = KERNELS[c]
    moments = sums[c - kernel :]  # the kernel looks at place `kernel` of what it is given
    return float(channel_cost(moments, DERIVATIVES, kernel, frame.R0, frame.p, curved, g, h))


def shown_directions(curvature: Array) -> tuple[Array, Array]:
    """Eigenvalues (k,) and directions (6, k) of what is above rounding in a curvature."""
    values, vectors = np.linalg.eigh(curvature)
    kept = values > RELATIVE_CURVATURE * max(float(values[-1]), 0.0)
    return values[kept], vectors[:, kept]


def descend(sums: Array, weights: Array, start: Frame) -> tuple[Frame, float]:
    """Gauss-Newton to the nearest minimum of the weighted cost; what is not shown stays."""
    frame = start
    cost, gradient, curvature = slope_and_curvature(sums, weights, frame)
    # Close to a minimum without noise the cost is the rounding of large sums and judges no step.
    rounding = COST_ROUNDING * weighted_power(sums, weights)
    for _ in range(STEPS):
        values, vectors = shown_directions(curvature)
        step = -vectors @ ((vectors.T @ gradient) / values)
        step *= min(1.0, LONGEST_TURN / max(float(np.linalg.norm(step[:3])), 1e-300))
        for _ in range(HALVINGS):
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


def weighted_power(sums: Array, weights: Array) -> float:
    """Weighted sum of |y|² over the channels of one joint."""
    return float(weights @ np.trace(sums[:, :3, :3], axis1=1, axis2=2))


def first_frames(sums: Array, weights: Array, prior: Frame) -> list[Frame]:
    """Where to start: Wahba's rotation; all right-angled ones too where it is open."""
    cross = sum(weights[c] * sums[c, 3:6, :3] for c in (0, 3))
    u, values, vt = np.linalg.svd(cross)
    if values[0] > 0.0 and values[1] > OPEN_ROTATION * values[0]:
        return [Frame(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, prior.p.copy())]
    return [prior, *(Frame(prior.R0 @ turn, prior.p.copy()) for turn in right_angled())]


def right_angled() -> list[Array]:
    """The 24 rotations that take axes to axes."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[np.arange(3), order] = signs
            if np.linalg.det(matrix) > 0.0:
                out.append(matrix)
    return out


def best_frame(sums: Array, weights: Array, prior: Frame) -> Frame:
    """The frame of lowest cost; of equal ones the nearest to the prior."""
    found = [descend(sums, weights, start) for start in first_frames(sums, weights, prior)]
    good = min(cost for _, cost in found) + SAME_COST * weighted_power(sums, weights)
    near = [frame for frame, cost in found if cost <= good]
    return min(near, key=lambda frame: float(np.linalg.norm(frame.offset_to(prior))))


def held_at(sums: Array, weights: Array, frame: Frame, prior: Frame, shown: Array) -> Frame:
    """The same frame with what the data don't show brought back to the prior.

    Args:
        shown: (6, 6) projector on the directions that count as shown, in the frame's axes; it is
            carried along as the frame turns.
    """
    for _ in range(STEPS):
        hidden = np.eye(6) - _in_axes(shown, frame.R0)
        back = hidden @ frame.offset_to(prior)
        if np.abs(back).max() < 1e-12:
            break
        frame = descend_within(sums, weights, frame.moved(back), shown)
    return frame


def descend_within(sums: Array, weights: Array, frame: Frame, shown: Array) -> Frame:
    """Gauss-Newton in the shown directions (6, 6; turns in the parent's axes) alone."""
    for _ in range(STEPS):
        projector = _in_axes(shown, frame.R0)
        values, vectors = np.linalg.eigh(projector)
        basis = vectors[:, values > 0.5]
        if not basis.shape[1]:
            break
        _, gradient, curvature = slope_and_curvature(sums, weights, frame)
        step = -basis @ np.linalg.solve(basis.T @ curvature @ basis, basis.T @ gradient)
        frame = frame.moved(step)
        if np.abs(step).max() < SMALLEST_STEP:
            break
    return frame


def _in_axes(projector: Array, r0: Array) -> Array:
    """A projector (6, 6) whose turns are in the parent's axes, with turns in the frame's own."""
    both = np.eye(6)
    both[:3, :3] = r0
    return np.asarray(both.T @ projector @ both)
