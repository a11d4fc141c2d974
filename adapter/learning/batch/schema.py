"""λ of every joint at once from the moments of link motion: exact without noise, weighted with.

Each joint is a problem of its own, its parent's motion being measured (eq. 18), see `frame_fit`.
What the data don't show is reported, and as near to zero as what they show lets it be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.learning import frame_fit
from adapter.learning.batch.moments import SchemaMoments, schema_moments
from adapter.learning.tree_data import TreeData
from adapter.model.spatial import Array, zxz_from_matrix
from adapter.physics.freedom import Freedom


@dataclass(frozen=True)
class SchemaResult:
    """λ and how well it is known.

    Directions are [turn; shift] in the parent's axes, as in `identifiability`.

    Attributes:
        lam: (n, 6) λ.
        std: (n, 6) standard deviation of each turn (rad) and shift (m) in the shown directions.
        observable: (n, 6) bool, whether the single turn or shift is shown on its own.
        freedom: what the data do not show.
        ranks: (n,) number of the shown directions by joint.
    """

    lam: Array
    std: Array
    observable: np.ndarray
    freedom: Freedom
    ranks: tuple[int, ...]


def schema_from_moments(data: TreeData, noise: Array | None = None) -> SchemaResult:
    """λ from measured motion of base and links, in one pass.

    With a fixed base `data.base` is the motion of rest: zeros, and a = -gravity. Velocities v
    may be missing (links that carry an IMU each); accelerations then show the positions.

    Args:
        noise: (4,) standard deviation of one sample of a link's w, v, a, dw, as it stands in the
            data, rad/s, m/s, m/s², rad/s². Where given it sets the weights and its power is taken
            out of the parents' moments; None: each channel is weighted by what its fit leaves.

    Raises:
        ModelError: no link motion, numbers that are not finite.
    """
    moments = schema_moments(data)
    joints = [_Joint(moments, j, noise) for j in range(data.tree.n)]
    shown = np.stack([joint.shown for joint in joints])
    return SchemaResult(
        lam=np.stack([np.r_[zxz_from_matrix(x.frame.R0), x.frame.p] for x in joints]),
        std=np.stack([joint.std for joint in joints]),
        observable=np.diagonal(shown, axis1=1, axis2=2) > 1.0 - 1e-6,  # but for rounding
        freedom=Freedom.of(np.eye(6) - shown, np.stack([x.frame.p for x in joints])),
        ranks=tuple(round(float(np.trace(p))) for p in shown),
    )


class _Joint:
    """The fit of one joint: weights, frame, directions shown."""

    def __init__(self, moments: SchemaMoments, j: int, noise: Array | None) -> None:
        self.count, self.raw = moments.count, moments.sums[j]
        self.used = np.array([True, moments.with_speed, True, True])
        zero = frame_fit.Frame(np.eye(3), np.zeros(3))
        given = None if noise is None else noise**2
        self.sums = self.raw if given is None else moments.without_noise(j, given)
        self.power = moments.power()[j]
        weights = self._weights(self.power / (3.0 * self.count))
        self.frame, _ = frame_fit.best_frame(self.sums, weights, zero)
        for _ in range(2):  # of weighting by what the fit leaves
            weights = self._weights(self._left_over() if given is None else 2.0 * given)
            self.frame, _ = frame_fit.descend(self.sums, weights, self.frame)
        clean = self.sums
        if given is None:
            clean = moments.without_noise(j, 0.5 * self._left_over())
        self._judge(clean, weights)
        freedom = Freedom.of(np.eye(6)[None] - self.shown, self.frame.p[None])
        self.frame = frame_fit.nearest(self.sums, weights, self.frame, zero, freedom)

    def _left_over(self) -> Array:
        """Mean square (4,) by component of what the fit leaves, with the data's own noise in."""
        return frame_fit.channel_costs(self.raw, self.frame) / (3.0 * self.count)

    def _weights(self, variance: Array) -> Array:
        """1 / variance by channel; a channel without signal or measurement weighs nothing."""
        # No weight looks below this share of a signal's power (1e-7 of its size): rounding of
        # moments.
        floor = 1e-14 * self.power / (3.0 * self.count)
        some = self.used & (self.power > 0.0)
        return np.where(some, 1.0 / np.where(some, np.maximum(variance, floor), 1.0), 0.0)

    def _judge(self, clean: Array, weights: Array) -> None:
        """Directions that count as shown, and the spread inside them, in the parent's axes."""
        values, vectors = frame_fit.curvature_in_parent(clean, weights, self.frame)
        # Noise alone makes curvature of the size of the square root of the count (schema learner).
        least = max(0.05**-2, 10.0 * np.sqrt(self.count))  # 0.05 rad or m: more is not shown
        shown = values > max(least, frame_fit.RELATIVE_CURVATURE * float(values[-1]))
        kept = vectors[:, shown]
        self.shown = kept @ kept.T
        self.std = np.sqrt(np.einsum("ak,k->a", kept**2, 1.0 / values[shown]))
