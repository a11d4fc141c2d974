"""λ of every joint at once from the moments of link motion: exact without noise, weighted with.

Each joint is a problem of its own, its parent's motion being measured (eq. 18): Wahba's problem
for the rotation, Gauss-Newton on eqs. 8a, 8b, 8c and 8d together for rotation and position. What
the data don't show is reported and held at the prior.

Changes of a frame are (turn, shift), turns in the frame's own axes, R0 <- R0 exp(turn),
p <- p + shift, as `schema_kernels` has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from adapter.errors import ModelError
from adapter.learning.batch.moments import (
    CHANNELS,
    KERNELS,
    LinkNoise,
    SchemaMoments,
    schema_moments,
)
from adapter.learning.schema_kernels import channel_cost
from adapter.learning.tree_data import TreeData
from adapter.model.spatial import (
    Array,
    exp_rotation,
    log_rotation,
    matrix_from_zxz,
    zxz_from_matrix,
)

# No weight looks below this share of a signal's power (1e-7 of its size): rounding of moments.
RESIDUAL_FLOOR = 1e-14
# Noise alone makes curvature of the size of the square root of the count (schema learner).
NOISE_CURVATURE = 10.0
ALONE = 1.0 - 1e-6  # share of a turn or shift inside the shown directions that counts as all
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


@dataclass(frozen=True)
class BatchSchemaSettings:
    """How λ is found from moments.

    Attributes:
        prior: (n, 6) λ that directions without data keep; zeros where None.
        noise: of the links' motion, as it stands in the data. Where given it sets the weights
            and its power is taken out of the parents' moments; None: each channel is weighted
            by what its fit leaves.
        largest_std: a direction with more than this (rad, m) counts as not shown.
        rounds: of weighting by what the fit leaves.
    """

    prior: Array | None = None
    noise: LinkNoise | None = None
    largest_std: float = 0.05
    rounds: int = 2

    def __post_init__(self) -> None:
        if not self.largest_std > 0.0:
            raise ModelError(f"largest_std must be above zero, got {self.largest_std}")
        if self.rounds < 1:
            raise ModelError(f"rounds must be at least 1, got {self.rounds}")


@dataclass(frozen=True)
class SchemaResult:
    """λ and how well it is known.

    Directions are [turn; shift] in the parent's axes, as in `identifiability`.

    Attributes:
        lam: (n, 6) λ.
        std: (n, 6) standard deviation of each turn (rad) and shift (m) in the shown directions.
        observable: (n, 6) bool, whether the single turn or shift is shown on its own.
        projectors: (n, 6, 6) onto the shown directions.
        ranks: (n,) their number by joint.
        residual: (n, 4) root mean square by component of what the fit leaves of w, v, a, dw.
        count: samples.
    """

    lam: Array
    std: Array
    observable: np.ndarray
    projectors: Array
    ranks: tuple[int, ...]
    residual: Array
    count: int

    @property
    def rank(self) -> int:
        """Directions shown of all joints together."""
        return sum(self.ranks)


def schema_from_moments(
    data: TreeData | SchemaMoments, settings: BatchSchemaSettings | None = None
) -> SchemaResult:
    """λ from measured motion of base and links, in one pass.

    With a fixed base `data.base` is the motion of rest: zeros, and a = -gravity. Velocities v
    may be missing (links that carry an IMU each); accelerations then show the positions.

    Raises:
        ModelError: no link motion, numbers that are not finite, a prior that does not fit.
    """
    settings = settings or BatchSchemaSettings()
    moments = data if isinstance(data, SchemaMoments) else schema_moments(data)
    n = moments.tree.n
    prior = np.zeros((n, 6)) if settings.prior is None else np.asarray(settings.prior, dtype=float)
    if prior.shape != (n, 6) or not np.isfinite(prior).all():
        raise ModelError(f"the prior of λ must be ({n}, 6) and finite, got shape {prior.shape}")
    joints = [_Joint(moments, settings, j, prior[j]) for j in range(n)]
    projectors = np.stack([joint.shown for joint in joints])
    return SchemaResult(
        lam=np.stack([np.r_[zxz_from_matrix(x.frame.R0), x.frame.p] for x in joints]),
        std=np.stack([joint.std for joint in joints]),
        observable=np.diagonal(projectors, axis1=1, axis2=2) > ALONE,
        projectors=projectors,
        ranks=tuple(round(float(np.trace(p))) for p in projectors),
        residual=np.sqrt(np.stack([joint.variance for joint in joints])),
        count=moments.count,
    )


class _Joint:
    """The fit of one joint: weights, frame, directions shown."""

    def __init__(
        self, moments: SchemaMoments, settings: BatchSchemaSettings, j: int, prior: Array
    ) -> None:
        self.count = moments.count
        self.raw = moments.sums[j]
        self.noise = settings.noise
        self.used = np.array([True, moments.with_speed, True, True])
        start = Frame(matrix_from_zxz(prior[:3]), prior[3:].copy())
        given = self._given_variance()
        self.sums = self.raw if given is None else _without(moments, j, given)
        self.power = np.trace(self.raw[:, :3, :3], axis1=1, axis2=2)
        weights = self._weights(self.power / (3.0 * self.count))
        self.frame = best_frame(self.sums, weights, start)
        for _ in range(settings.rounds):
            self.variance = self._left_over()
            weights = self._weights(self.variance if given is None else 2.0 * given)
            self.frame, _ = descend(self.sums, weights, self.frame)
        self.variance = self._left_over()
        clean = _without(moments, j, 0.5 * self.variance) if given is None else self.sums
        self._judge(clean, weights, settings.largest_std)
        self.frame = held_at(self.sums, weights, self.frame, start, self.shown)

    def _given_variance(self) -> Array | None:
        if self.noise is None:
            return None
        return np.array([getattr(self.noise, name) for name in CHANNELS]) ** 2

    def _left_over(self) -> Array:
        """Mean square (4,) by component of what the fit leaves, with the data's own noise in."""
        return channel_costs(self.raw, self.frame) / (3.0 * self.count)

    def _weights(self, variance: Array) -> Array:
        """1 / variance by channel; a channel without signal or measurement weighs nothing."""
        floor = RESIDUAL_FLOOR * self.power / (3.0 * self.count)
        some = self.used & (self.power > 0.0)
        return np.where(some, 1.0 / np.where(some, np.maximum(variance, floor), 1.0), 0.0)

    def _judge(self, clean: Array, weights: Array, largest_std: float) -> None:
        """Directions that count as shown, and the spread inside them, in the parent's axes."""
        _, _, own = slope_and_curvature(clean, weights, self.frame)
        turn = np.eye(6)
        turn[:3, :3] = self.frame.R0
        values, vectors = np.linalg.eigh(turn @ own @ turn.T)
        least = max(largest_std**-2, NOISE_CURVATURE * np.sqrt(self.count))
        shown = values > max(least, RELATIVE_CURVATURE * float(values[-1]))
        kept = vectors[:, shown]
        self.shown = kept @ kept.T
        self.std = np.sqrt(np.einsum("ak,k->a", kept**2, 1.0 / values[shown]))


def _without(moments: SchemaMoments, j: int, variance: Array) -> Array:
    """Moments of joint j with the parent's noise (4,) of w, v, a, dw taken out."""
    return moments.without_noise(np.tile(variance, (moments.tree.n, 1)))[j]


# One frame, from its moments


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
    unused = np.zeros(6), np.zeros((0, 6))
    costs = [_channel(sums, c, frame, *unused) for c in range(len(CHANNELS))]
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
