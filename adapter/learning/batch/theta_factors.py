"""What all samples say of θ: one triangular factor per measured row of the dynamics network.

The row of joint j sees the links that hang on it and no others, so each row keeps the R of its
own [Y | y], updated chunk by chunk by QR of [R; Y_chunk | y_chunk]: |Y θ - y| = |R [θ; -1]| for
all samples together, with none of the digits that Y^T Y would lose. Weights multiply a row's
factor and may change afterwards at no cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from adapter.errors import ModelError
from adapter.learning.tree_data import TreeData, check_dynamics, check_finite
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.networks import (
    DTYPE,
    MOMENT_Z,
    PER_BODY,
    bodies_on,
    link_motion,
    wrench_regressors,
)

SUPERVISIONS = ("torques", "wrenches", "both")
CHUNK = 1024  # samples a QR update takes in
SMALLEST_SCALE = 1e-6  # of the median row: a row that is zero throughout gets the median's scale


@dataclass(frozen=True)
class RowFactor:
    """All samples of one row: a joint's torque, or a force or moment vector.

    Attributes:
        name: "torque of JOINT", "force on BODY" or "moment on BODY".
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

    @cached_property
    def size(self) -> float:
        """Root mean square of what was measured."""
        return float(np.linalg.norm(self.r[:, -1]) / np.sqrt(self.count))


def row_factors(
    data: TreeData,
    lam: Array,
    supervision: str = "torques",
    wrenches: Array | None = None,
) -> list[RowFactor]:
    """The factors of all rows.

    Args:
        data: joint signals, torques and base motion; the links' motion follows from λ.
        lam: (n, 6) λ.
        supervision: "torques", "wrenches" or "both" (eq. 17).
        wrenches: (m, bodies, 6) measured total wrench [f; m] on every body, in its frame
            (eq. 15); needed for the last two.

    Raises:
        ModelError: unknown supervision, missing wrenches, shapes that don't fit, numbers that
            are not finite.
    """
    _check(data, lam, supervision, wrenches)
    groups = _groups(data.tree, supervision)
    factors: dict[str, Array] = {}
    frames = torch.as_tensor(lam, dtype=DTYPE)
    for start in range(0, len(data), CHUNK):
        rows = slice(start, start + CHUNK)
        part = data.take(rows)
        joints = part.joint_signals()
        with torch.no_grad():
            k = link_motion(data.tree, frames, joints, part.base.torch())
            wide = wrench_regressors(data.tree, frames, joints[0], k)
        measured = None if wrenches is None else wrenches[rows]
        for group in groups:
            table = group.table(wide, part, measured)
            before = factors.get(group.name, table[:0])
            factors[group.name] = qr_factor(np.concatenate([before, table]))
    return [
        RowFactor(g.name, g.kind, g.bodies, factors[g.name], len(data) * g.numbers) for g in groups
    ]


def scales(rows: list[RowFactor]) -> Array:
    """A first standard deviation of every row: its size; for rows that are zero the median's."""
    sizes = np.array([row.size for row in rows])
    usual = float(np.median(sizes[sizes > 0.0])) if (sizes > 0.0).any() else 1.0
    return np.where(sizes > SMALLEST_SCALE * usual, sizes, usual)


def system(rows: list[RowFactor], std: Array, bodies: tuple[int, ...]) -> tuple[Array, Array]:
    """Triangular system R θ = b of some bodies, from rows that see those bodies alone.

    Args:
        std: of every row; its factor is divided by it.
        bodies: in the order of the columns.

    Returns:
        R (k, 10 bodies) and b (k,), k at most 10 bodies + 1: the last row, where there is one,
        holds what no θ explains.
    """
    place = {body: PER_BODY * k for k, body in enumerate(bodies)}
    width = PER_BODY * len(bodies)
    stacked = []
    for row, sigma in zip(rows, std, strict=True):
        columns = [place[body] + c for body in row.bodies for c in range(PER_BODY)]
        block = np.zeros((len(row.r), width + 1))
        block[:, [*columns, width]] = row.r / sigma
        stacked.append(block)
    r = qr_factor(np.concatenate(stacked))
    return r[:, :width], r[:, width]


def qr_factor(table: Array) -> Array:
    """Upper triangular R of a table's QR."""
    return np.asarray(np.linalg.qr(table, mode="r"), dtype=np.float64)


@dataclass(frozen=True)
class _Group:
    """A row to be: which body it is measured on, what it sees, where its numbers are."""

    name: str
    kind: str
    body: int
    bodies: tuple[int, ...]
    floating: bool

    @property
    def numbers(self) -> int:
        return 1 if self.kind == "torque" else 3

    def table(self, wide: list[Tensor], part: TreeData, wrenches: Array | None) -> Array:
        """[Y | y] (m numbers, 10 bodies + 1) of a chunk."""
        places = {"torque": [MOMENT_Z], "force": [0, 1, 2], "moment": [3, 4, 5]}[self.kind]
        y = wide[self.body][:, places].numpy()
        if self.kind == "torque":
            measured = part.tau[:, [self.body + 5 * self.floating]]
        elif wrenches is not None:
            measured = wrenches[:, self.body][:, places]
        else:
            measured = part.tau[:, places]
        table = np.concatenate([y, measured[:, :, None]], axis=2)
        return np.asarray(table.reshape(-1, table.shape[2]))


def _groups(tree: Tree, supervision: str) -> list[_Group]:
    """The rows that a supervision measures; a floating base's wrench belongs to all of them."""
    first, seen = int(tree.floating), bodies_on(tree)
    out = []
    for body, name in enumerate(tree.body_names):
        bodies, base = tuple(seen[body]), body < first
        if base or supervision != "torques":
            out += [
                _Group(f"{k} on {name}", k, body, bodies, tree.floating)
                for k in ("force", "moment")
            ]
        if not base and supervision != "wrenches":
            joint = tree.joint_names[body - first]
            out.append(_Group(f"torque of {joint}", "torque", body, bodies, tree.floating))
    return out


def _check(data: TreeData, lam: Array, supervision: str, wrenches: Array | None) -> None:
    if supervision not in SUPERVISIONS:
        raise ModelError(f"no supervision '{supervision}'; have: {', '.join(SUPERVISIONS)}")
    if lam.shape != (data.tree.n, 6):
        raise ModelError(f"λ must have shape ({data.tree.n}, 6), got {lam.shape}")
    if len(data) == 0:
        raise ModelError("θ can't be learned from no samples")
    wanted = (len(data), data.tree.bodies, 6)
    if supervision != "torques" and (wrenches is None or wrenches.shape != wanted):
        got = "none" if wrenches is None else f"shape {wrenches.shape}"
        raise ModelError(f"supervision '{supervision}' needs wrenches {wanted}, got {got}")
    check_dynamics(data)
    check_finite({"tau": data.tau, "λ": lam})
    if supervision != "torques":
        check_finite({"wrenches": wrenches})
