"""What data can tell of θ and λ, counted over random motion.

θ: the rank of the regressor is the number of base parameters, the combinations that torques
show. λ: the motion of link j, given that of its parent, depends on small turns and shifts of
frame j; what it does not depend on, no proprioception will ever show (reading notes).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adapter.model.inertia import BODY_SIZE
from adapter.model.spatial import Array, matrix_from_zxz, skew
from adapter.model.tree import BASE, Tree
from adapter.physics.freedom import Freedom
from adapter.physics.kernels import JointMotion, base_at_rest, frames_of, link_motions, regressors

# Singular values below this, relative to the largest, count as zero. Random motion leaves a gap
# of many decades: true ones stay above 1e-6 on arms, rounding below 1e-14.
RANK_TOLERANCE = 1e-10

# Turns and shifts that change a link's motion by less than this share do not count as shown: axes
# that a URDF has upright to five digits, and no more, show nothing that a sensor could tell.
LEAST_SHOWN = 1e-4

# From such a share of a parameter's own direction that data show it is known, and learned, alone.
SHOWN_ALONE = 0.99

# Appends columns to the regressor: (q, dq, ddq), each (m, n), to (m, rows, k).
ExtraColumns = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class BaseParameters:
    """The identifiable subspace of θ (and of the coefficients of extra columns).

    Attributes:
        rank: number of base parameters.
        basis: (columns, rank) orthonormal; `basis.T @ theta.ravel()` is what torques can show.
    """

    rank: int
    basis: Array

    def shown_map(self) -> Array:
        """(columns, columns): of a difference in θ what torques show.

        Of all differences that torques cannot tell from it the one that is smallest against a
        body of 1 kg, 10 cm across.
        """
        size = np.tile(BODY_SIZE, len(self.basis) // len(BODY_SIZE))
        rows = np.linalg.qr(self.basis * size[:, None])[0]
        return np.asarray(size[:, None] * (rows @ rows.T) / size)


@dataclass(frozen=True)
class FrameObservability:
    """What link motion shows of each joint frame.

    A direction is [turn; shift] of frame j against its parent: rotation vector (rad) and shift
    (m), both in the parent's axes: R0 becomes exp(turn) R0, p becomes p + shift.

    Attributes:
        rank: number of observable directions of all joints together.
        ranks: (n,) by joint.
        projectors: (n, 6, 6) onto the observable directions.
        flags: (n, 6) bool, whether the single turn or shift is observable on its own.
        freedom: how far the frames may go and links still move the same.
    """

    rank: int
    ranks: tuple[int, ...]
    projectors: Array
    flags: np.ndarray
    freedom: Freedom


def numerical_rank(matrix: Array, tolerance: float = RANK_TOLERANCE) -> tuple[int, Array]:
    """Rank of a tall matrix and an orthonormal basis (columns, rank) of its row space.

    Columns are scaled to equal length first, so that units don't decide; QR first makes the
    price of the SVD that of the columns.
    """
    length = np.linalg.norm(matrix, axis=0)
    scale = np.where(length > tolerance * max(float(length.max()), 1e-300), length, np.inf)
    triangle = np.linalg.qr(matrix / scale, mode="r")
    _, values, rows = np.linalg.svd(triangle, full_matrices=False)
    rank = int(np.count_nonzero(values > tolerance * values[0])) if values[0] > 0 else 0
    # Row space in the original units: the scaled rows times the scale, made orthonormal again.
    spanning = rows[:rank] * np.where(np.isfinite(scale), scale, 0.0)
    basis = np.linalg.qr(spanning.T)[0]
    return rank, np.asarray(basis, dtype=np.float64)


def random_motion(tree: Tree, samples: int, seed: int = 0) -> JointMotion:
    """Independent random joint states that excite everything a joint can."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (samples, tree.n))  # and as many m of what slides
    return JointMotion(q, rng.normal(size=q.shape), rng.normal(size=q.shape) * 3.0)


def random_regressor(
    tree: Tree, lam: Array, gravity: Array, samples: int, seed: int = 0, wrench: bool = True
) -> tuple[JointMotion, Array]:
    """Random motion, and the regressor (samples, rows, 10 bodies) over it.

    Arguments as of `base_parameters`; wrench: whether that on a floating base is known.
    """
    motion = random_motion(tree, samples, seed)
    base = _random_base(tree, gravity, samples, seed)
    matrix = np.empty((samples, tree.rows, 10 * tree.bodies))
    regressors(frames_of(tree, lam), motion, base, matrix)
    return motion, matrix if wrench else matrix[:, tree.rows - tree.n :]


def base_parameters(
    tree: Tree, lam: Array, gravity: Array, extra: ExtraColumns | None = None
) -> BaseParameters:
    """The identifiable subspace of θ, from the regressor over random motion.

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        gravity: (3,) in base axes, m/s². A floating base gets random motion of its own.
        extra: columns of further effects to be counted beside θ (friction, offsets, ...).
    """
    samples = max(20, 4 * 10 * tree.bodies // tree.rows + 10)
    motion, matrix = random_regressor(tree, lam, gravity, samples)
    if extra is not None:
        matrix = np.concatenate([matrix, extra(*motion)], axis=2)
    rank, basis = numerical_rank(matrix.reshape(-1, matrix.shape[2]))
    return BaseParameters(rank, basis)


def _random_base(tree: Tree, gravity: Array, samples: int, seed: int = 0) -> Array:
    """Motion rows (samples, 12) of a floating base, or (1, 12) of one at rest."""
    if not tree.floating:
        return base_at_rest(gravity)[None]
    rng = np.random.default_rng(seed + 1)
    return np.concatenate([rng.normal(size=(samples, 3)) for _ in range(4)], axis=1)


def frame_observability(tree: Tree, lam: Array, gravity: Array) -> FrameObservability:
    """Turns and shifts of every joint frame that link motion shows over random motion.

    Args:
        tree: N and A.
        lam: (n, 6) λ.
        gravity: (3,) in base axes, m/s². A floating base gets random motion of its own.
    """
    motion = random_motion(tree, 40)
    base = _random_base(tree, gravity, len(motion.q))
    links = np.empty((*motion.q.shape, 12))
    link_motions(frames_of(tree, lam), motion, base, links)
    bases = []
    for j, i in enumerate(tree.parent):
        parent = np.broadcast_to(base, (len(links), 12)) if i == BASE else links[:, i]
        joint = motion.q[:, j], motion.dq[:, j]
        matrix = frame_jacobian(parent, joint, np.asarray(lam)[j], tree.slides[j])
        _, values, rows = np.linalg.svd(matrix, full_matrices=False)
        shown = values > LEAST_SHOWN * values[0]
        bases.append(rows[shown].T if values[0] >= 1e-9 else np.zeros((6, 0)))
    projectors = np.stack([b @ b.T for b in bases])
    ranks = tuple(b.shape[1] for b in bases)
    flags = np.diagonal(projectors, axis1=1, axis2=2) > 1.0 - 1e-6
    freedom = Freedom.of(np.eye(6) - projectors, np.asarray(lam)[:, 3:])
    return FrameObservability(sum(ranks), ranks, projectors, flags, freedom)


def frame_jacobian(
    parent: Array, joint: tuple[Array, Array], lam_j: Array, slides: bool = False
) -> Array:
    """Change of link j's motion, in the parent's axes, with [turn; shift] of its frame, (.., 6).

    R becomes exp(φ) R: what reads Rᵀ x changes by Rᵀ [x ×] φ (eqs. 8a-8d); turning all rows into
    the parent's axes changes no rank. The parent's motion is taken as measured: by row
    operations the rank over the whole chain is the sum of the ranks found so.

    A joint that slides has the lever of q z beside that of p, and 2 w_j x dq z in its acceleration.

    Args:
        parent: (m, 12) motion rows of the parent; joint: q, dq (m,); lam_j: (6,) its λ.
        slides: whether the joint slides.
    """
    v, w, a, dw = np.split(parent, 4, axis=1)
    p, axis = lam_j[3:], matrix_from_zxz(lam_j[:3])[:, 2]
    zero, (q, dq) = np.zeros((len(w), 3, 3)), (x[:, None, None] for x in joint)
    lever, across = skew(dw) + skew(w) @ skew(w), skew(axis) @ skew(w)
    speed, pull, spin = skew(v + np.cross(w, p)), skew(a + lever @ p), skew(dw)
    if slides:
        bent = skew(np.cross(w, axis)) + skew(w) @ skew(axis)
        speed = speed - q * across
        pull = pull - q * (skew(axis) @ skew(dw) + bent @ skew(w)) - 2.0 * dq * across
    else:
        spin = spin - dq * across
    rows = [
        np.concatenate([speed, skew(w)], axis=2),
        np.concatenate([skew(w), zero], axis=2),
        np.concatenate([pull, lever], axis=2),
        np.concatenate([spin, zero], axis=2),
    ]
    return np.concatenate(rows, axis=1).reshape(-1, 6)
