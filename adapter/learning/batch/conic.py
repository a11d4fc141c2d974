"""Conic programs over bodies that can exist, as Clarabel takes them.

A body can exist where its pseudo-inertia (4, 4) is positive definite; a triangle of that matrix,
in which what is off the diagonal counts twice, is the solver's cone.
"""

from __future__ import annotations

import clarabel
import numpy as np
from scipy import sparse

from adapter.model.spatial import Array

LENGTH = 0.1  # m, in units of which the entries of a link's pseudo-inertia (kg) are of like size
SOLVED = ("Solved", "AlmostSolved")
# Where the entries of a body's matrix are those of a possible body; where a number is not below 0.
POSSIBLE, NONNEGATIVE = clarabel.PSDTriangleConeT(4), clarabel.NonnegativeConeT(1)

_UPPER = [(row, column) for column in range(4) for row in range(column + 1)]


def entries(matrix: Array) -> Array:
    """(..., 10) of symmetric matrices (..., 4, 4): as Clarabel wants a triangle."""
    twice = np.sqrt(2.0)
    parts = [matrix[..., i, j] * (1.0 if i == j else twice) for i, j in _UPPER]
    return np.stack(parts, axis=-1)


def matrices(entry: Array) -> Array:
    """Symmetric matrices (..., 4, 4) of their entries (..., 10)."""
    out = np.empty((*entry.shape[:-1], 4, 4))
    for k, (i, j) in enumerate(_UPPER):
        out[..., i, j] = out[..., j, i] = entry[..., k] / (1.0 if i == j else np.sqrt(2.0))
    return out


def solve_conic(
    quadratic: Array, linear: Array, left: Array, right: Array, in_cones: list[object]
) -> tuple[Array, int, bool]:
    """Minimise x·Q x / 2 + linear·x where right - left x lies in cones: x, steps, solved."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10  # relative and absolute
    # Its scaling of rows would turn the cones; the units above scale better.
    settings.equilibrate_enable = False
    upper = sparse.triu(sparse.csc_matrix(quadratic), format="csc")
    solver = clarabel.DefaultSolver(
        upper, linear, sparse.csc_matrix(left), right, in_cones, settings
    )
    answer = solver.solve()
    return np.array(answer.x), int(answer.iterations), str(answer.status) in SOLVED
