"""λ of every joint at once from the moments of link motion: exact without noise, weighted with.

Each joint is a problem of its own, its parent's motion being measured (eq. 18), see `frame_fit`.
What the data don't show is reported, and as near to the prior as what they show lets it be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning.batch.moments import LinkNoise, SchemaMoments, schema_moments
from adapter.learning.frame_fit import (
    RELATIVE_CURVATURE,
    Frame,
    best_frame,
    channel_costs,
    descend,
    nearest,
    slope_and_curvature,
)
from adapter.learning.schema_kernels import CHANNELS
from adapter.learning.tree_data import TreeData
from adapter.model.spatial import Array, matrix_from_zxz, zxz_from_matrix
from adapter.physics.freedom import Freedom

# No weight looks below this share of a signal's power (1e-7 of its size): rounding of moments.
RESIDUAL_FLOOR = 1e-14
# Noise alone makes curvature of the size of the square root of the count (schema learner).
NOISE_CURVATURE = 10.0
ALONE = 1.0 - 1e-6  # share of a turn or shift inside the shown directions that counts as all


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
        freedom: what they do not show, which is as near to the prior as can be.
        ranks: (n,) their number by joint.
        residual: (n, 4) root mean square by component of what the fit leaves of w, v, a, dw.
        count: samples.
    """

    lam: Array
    std: Array
    observable: np.ndarray
    projectors: Array
    freedom: Freedom
    ranks: tuple[int, ...]
    residual: Array
    count: int

    @property
    def rank(self) -> int:
        """Directions shown of all joints together."""
        return sum(self.ranks)


def schema_from_moments(
    data: TreeData, settings: BatchSchemaSettings | None = None
) -> SchemaResult:
    """λ from measured motion of base and links, in one pass.

    With a fixed base `data.base` is the motion of rest: zeros, and a = -gravity. Velocities v
    may be missing (links that carry an IMU each); accelerations then show the positions.

    Raises:
        ModelError: no link motion, numbers that are not finite, a prior that does not fit.
    """
    settings, moments = settings or BatchSchemaSettings(), schema_moments(data)
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
        freedom=Freedom.of(np.eye(6) - projectors, np.stack([x.frame.p for x in joints])),
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
        self.used = np.array([True, moments.with_speed, True, True])
        start = Frame(matrix_from_zxz(prior[:3]), prior[3:].copy())
        noise, given = settings.noise, None
        if noise is not None:
            given = np.array([getattr(noise, name) for name in CHANNELS]) ** 2
        self.sums = self.raw if given is None else _without(moments, j, given)
        self.power = np.trace(self.raw[:, :3, :3], axis1=1, axis2=2)
        weights = self._weights(self.power / (3.0 * self.count))
        self.frame, _ = best_frame(self.sums, weights, start)
        for _ in range(settings.rounds):
            self.variance = self._left_over()
            weights = self._weights(self.variance if given is None else 2.0 * given)
            self.frame, _ = descend(self.sums, weights, self.frame)
        self.variance = self._left_over()
        clean = _without(moments, j, 0.5 * self.variance) if given is None else self.sums
        self._judge(clean, weights, settings.largest_std)
        freedom = Freedom.of(np.eye(6)[None] - self.shown, self.frame.p[None])
        self.frame = nearest(self.sums, weights, self.frame, start, freedom)

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
