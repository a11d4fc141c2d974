"""One pass over the samples: the second moments that hold all they say of every joint frame.

Eqs. 8a-8d turned by Rz(q_j) read `y = R0^T z(p)` with y known from link j and z linear in known
signals of its parent, so the cost of any number of samples lives in the moments of [y, s]
(`schema_kernels` has the algebra of w, v and a; angular acceleration has that of w).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning.schema_kernels import CHANNELS, WIDTH, accumulate, signals
from adapter.learning.tree_data import TreeData, check_motion
from adapter.model.spatial import Array
from adapter.physics.kernels import JointMotion, jit

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
