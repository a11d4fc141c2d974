"""What all samples say of θ: one triangular factor per measured row of the dynamics.

The row of joint j sees the links that hang on it and no others, so each row keeps the R of its
own [Y | y], updated chunk by chunk by QR of [R; Y_chunk | y_chunk]: |Y θ - y| = |R [θ; -1]| for
all samples together, with none of the digits that Y^T Y would lose. Weights multiply a row's
factor and may change afterwards at no cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning.tree_data import TreeData, check_dynamics, check_finite
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import frames_of, regressors

CHUNK = 1024  # samples a QR update takes in


@dataclass(frozen=True)
class RowFactor:
    """All samples of one row: a joint's torque, or the force or the moment on a floating base.

    Attributes:
        name: "torque of JOINT", "force on BASE" or "moment on BASE".
        kind: "torque", "force" or "moment".
        bodies: rows of θ that it sees, in the order of the factor's columns.
        r: (10 bodies + 1, 10 bodies + 1) upper triangular factor of [Y | y].
        count: numbers measured.
    """

    name: str
    kind: str
    bodies: tuple[int, ...]
    r: Array
    count: int

    def residual(self, theta: Array) -> float:
        """Root mean square of Y θ - y for θ of the whole tree (bodies, 10)."""
        left = self.r @ np.r_[theta[list(self.bodies)].ravel(), -1.0]
        return float(np.linalg.norm(left) / np.sqrt(self.count))


def row_factors(data: TreeData, lam: Array) -> list[RowFactor]:
    """The factors of all rows.

    Args:
        data: joint signals, torques and base motion; the links' motion follows from λ.
        lam: (n, 6) λ.

    Raises:
        ModelError: no samples, a λ of another shape, numbers that are not finite.
    """
    tree = data.tree
    if lam.shape != (tree.n, 6):
        raise ModelError(f"λ must have shape ({tree.n}, 6), got {lam.shape}")
    if len(data) == 0:
        raise ModelError("θ can't be learned from no samples")
    check_dynamics(data)
    check_finite({"tau": data.tau, "λ": lam})
    frames, rows = frames_of(tree, lam), _rows(tree)
    factors = [np.zeros((0, 10 * len(bodies) + 1)) for *_, bodies in rows]
    for start in range(0, len(data), CHUNK):
        part = data.take(slice(start, start + CHUNK))
        Y = np.empty((len(part), tree.rows, 10 * tree.bodies))
        regressors(frames, part.joints(), part.base.rows(), Y)
        for k, (_, _, places, bodies) in enumerate(rows):
            own = Y[:, places].reshape(len(part), len(places), -1, 10)[:, :, list(bodies)]
            table = np.concatenate(
                [own.reshape(len(part), len(places), -1), part.tau[:, places, None]], axis=2
            )
            factors[k] = qr_factor(np.vstack([factors[k], table.reshape(-1, table.shape[2])]))
    return [
        RowFactor(name, kind, bodies, factor, len(data) * len(places))
        for (name, kind, places, bodies), factor in zip(rows, factors, strict=True)
    ]


def _rows(tree: Tree) -> list[tuple[str, str, list[int], tuple[int, ...]]]:
    """Name, kind, numbers among the torques, and the bodies that it sees, of each row."""
    base, first = tree.rows - tree.n, tree.bodies - tree.n
    rows = []
    for kind, places in (("force", [0, 1, 2]), ("moment", [3, 4, 5])) if base else ():
        rows.append((f"{kind} on {tree.base_name}", kind, places, tuple(range(tree.bodies))))
    for j, joint in enumerate(tree.joint_names):
        bodies = tuple(first + k for k in range(tree.n) if j in tree.path_to(k))
        rows.append((f"torque of {joint}", "torque", [base + j], bodies))
    return rows


def scales(rows: list[RowFactor]) -> Array:
    """A first standard deviation of every row: its size; for rows that are zero the median's."""
    sizes = np.array([np.linalg.norm(row.r[:, -1]) / np.sqrt(row.count) for row in rows])
    usual = float(np.median(sizes[sizes > 0.0])) if (sizes > 0.0).any() else 1.0
    return np.where(sizes > 1e-6 * usual, sizes, usual)  # a row of zeros


def system(rows: list[RowFactor], std: Array, bodies: tuple[int, ...]) -> tuple[Array, Array]:
    """Triangular system R θ = b of some bodies, from rows that see those bodies alone.

    Args:
        std: of every row; its factor is divided by it.
        bodies: in the order of the columns.

    Returns:
        R (k, 10 bodies) and b (k,), k at most 10 bodies + 1: the last row, where there is one,
        holds what no θ explains.
    """
    place = {body: 10 * k for k, body in enumerate(bodies)}
    width = 10 * len(bodies)
    stacked = []
    for row, sigma in zip(rows, std, strict=True):
        columns = [place[body] + c for body in row.bodies for c in range(10)]
        block = np.zeros((len(row.r), width + 1))
        block[:, [*columns, width]] = row.r / sigma
        stacked.append(block)
    r = qr_factor(np.concatenate(stacked))
    return r[:, :width], r[:, width]


def qr_factor(table: Array) -> Array:
    """Upper triangular R of a table's QR."""
    return np.asarray(np.linalg.qr(table, mode="r"), dtype=np.float64)
