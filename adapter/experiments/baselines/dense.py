"""The baselines' large matrices in float64: on a GPU where there is one, else by numpy and scipy.

On a CPU numpy's products are about twice as fast as torch's, so torch serves the GPU alone.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import linalg

from adapter.model.spatial import Array


def accelerator() -> torch.device | None:
    """The GPU; None where there is none."""
    return torch.device("cuda") if torch.cuda.is_available() else None


def gram(table: Array) -> Array:
    """Tᵀ T of a table T (m, k)."""
    place = accelerator()
    if place is None:
        return np.asarray(table.T @ table)
    there = torch.from_numpy(table).to(place)
    return np.asarray((there.T @ there).cpu().numpy())


def solve_positive(matrix: Array, right: Array) -> Array:
    """A⁻¹ B by Cholesky, A (k, k) positive definite and overwritten, B (k, outputs).

    Raises:
        LinAlgError: A is not positive definite in float64.
    """
    place = accelerator()
    if place is None:
        factor = linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        return np.asarray(linalg.cho_solve(factor, right, check_finite=False))
    lower, trouble = torch.linalg.cholesky_ex(torch.from_numpy(matrix).to(place))
    if int(trouble):
        raise linalg.LinAlgError("the matrix is not positive definite")
    there = torch.from_numpy(np.ascontiguousarray(right)).to(place)
    return np.asarray(torch.cholesky_solve(there, lower).cpu().numpy())
