"""λ of every joint at once from the moments of link motion: exact without noise, weighted with.

Each joint is a problem of its own, its parent's motion being measured (eq. 18), see `frame_fit`.
What the data don't show is reported, and as near to zero as what they show lets it be.

One pass over the samples gives the moments. Eqs. 8a-8d turned by Rz(q_j) read `y = R0^T z(p)` with
y known from link j and z linear in known signals of its parent, so the cost of any number of
samples lives in the moments of [y, s] (`schema_kernels` has the algebra of w, v and a; angular
acceleration has that of w).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning import frame_fit
from adapter.learning.schema_kernels import CHANNELS, WIDTH, accumulate, signals
from adapter.learning.tree_data import TreeData, check_motion
from adapter.model.spatial import Array, zxz_from_matrix
from adapter.physics.freedom import Freedom
from adapter.physics.kernels import JointMotion, jit


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
        # directions that count as shown, and the spread inside them, in the parent's axes
        values, vectors = frame_fit.curvature_in_parent(clean, weights, self.frame)
        # Noise alone makes curvature of the size of the square root of the count (schema learner).
        least = max(0.05**-2, 10.0 * np.sqrt(self.count))  # 0.05 rad or m: more is not shown
        shown = values > max(least, frame_fit.RELATIVE_CURVATURE * float(values[-1]))
        kept = vectors[:, shown]
        self.shown = kept @ kept.T
        self.std = np.sqrt(np.einsum("ak,k->a", kept**2, 1.0 / values[shown]))
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


# Which of the parent's signals stand in s, three numbers each; products of w_i come last in a's.
_PARENT_SIGNALS = (("w",), ("v", "w"), ("a", "dw"), ("dw",))


@dataclass(frozen=True)
class SchemaMoments:
    """Sums over samples of [y, s] [y, s]^T, by joint and channel.

    Attributes:
        sums: (n, 4, 15, 15), channels in the order of `CHANNELS`.
        count: number of samples.
        with_speed: whether velocities v were measured (else their channel is zero).
    """

    sums: Array
    count: int
    with_speed: bool

    def power(self) -> Array:
        """Sum of |y|² (n, 4)."""
        return np.asarray(np.trace(self.sums[:, :, :3, :3], axis1=2, axis2=3))

    def without_noise(self, j: int, variance: Array) -> Array:
        """`sums` of joint j (4, 15, 15) with the noise power of the parent's signals taken out.

        Noise in what a fit takes as input passes for excitation and shrinks what is found
        (errors in variables); its expected power is known once its variance is.

        Args:
            variance: (4,) of the parent's w, v, a, dw.
        """
        out = self.sums[j].copy()
        for channel, names in enumerate(_PARENT_SIGNALS):
            if channel == CHANNELS.index("v") and not self.with_speed:
                continue
            for block, name in enumerate(names):
                place = 3 + 3 * block + np.arange(3)
                out[channel, place, place] -= self.count * variance[CHANNELS.index(name)]
        return out


def schema_moments(data: TreeData) -> SchemaMoments:
    """The moments of every joint.

    Raises:
        ModelError: no samples, no measured motion of the links, or a number that is not finite.
    """
    if data.links is None:
        raise ModelError("the body schema is learned from the links' motion, and none is given")
    if len(data) == 0:
        raise ModelError("the body schema can't be learned from no samples")
    with_speed = data.links.v is not None and data.base.v is not None
    check_motion(data)
    base, links = data.base.rows(), data.links.rows()
    sums = np.zeros((data.tree.n, len(CHANNELS), WIDTH, WIDTH))
    tree = np.array(data.tree.parent, dtype=np.int64), np.array(data.tree.slides)
    _accumulate(tree, JointMotion(data.q, data.dq, data.ddq), base, links, sums)
    if not with_speed:
        sums[:, CHANNELS.index("v")] = 0.0
    return SchemaMoments(sums, len(data), with_speed)


@jit
def _accumulate(tree, joints, base, links, sums):
    """Add every sample: `JointMotion`, base (m, 12), links (m, n, 12) to sums (n, 4, 15, 15)."""
    (parent, slides), (q, dq, ddq) = tree, joints
    s = np.zeros((3, 15))
    turn = np.zeros(6)
    for m in range(q.shape[0]):
        for j in range(parent.shape[0]):
            up = base[m] if parent[j] < 0 else links[m, parent[j]]
            at, speed, gain = q[m, j], dq[m, j], ddq[m, j]
            signals(slides[j], (at, speed, gain), up, links[m, j], s)
            accumulate(s, 1.0, sums[j])
            # 8d as R0^T dw_i = Rz(q)(dw_j - ddq z - w_j x z dq)
            if slides[j]:
                at, speed, gain = 0.0, 0.0, 0.0
            x = links[m, j, 9] - links[m, j, 4] * speed
            y = links[m, j, 10] + links[m, j, 3] * speed
            c, sn = np.cos(at), np.sin(at)
            turn[0], turn[1] = c * x - sn * y, sn * x + c * y
            turn[2] = links[m, j, 11] - gain
            for k in range(3):
                turn[3 + k] = up[9 + k]
            for a in range(6):
                for b in range(6):
                    sums[j, 3, a, b] += turn[a] * turn[b]
