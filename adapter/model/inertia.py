"""Inertial parameters of a body and their physical consistency.

θ = [m mX mY mZ XX XY XZ YY YZ ZZ] (paper, eq. 4b): mass in kg, first moments in kg m, inertia
tensor about the origin of the body's frame in kg m². A body exists when its 4x4 pseudo-inertia
is positive definite (Wensing, Kim, Slotine 2018). The log-Cholesky vector [α d1 d2 d3 s12 s23
s13 t1 t2 t3] (Rucker, Wensing 2022) reaches exactly those bodies, without constraints.
All functions take leading batch dimensions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adapter.model.spatial import Array, skew

PARAMETERS = ("m", "mX", "mY", "mZ", "XX", "XY", "XZ", "YY", "YZ", "ZZ")
UNITS = ("kg", *["kg m"] * 3, *["kg m²"] * 6)  # of these
# Ten parameters of a body of 1 kg, 10 cm across, and kg that none is lighter than for such sizes.
BODY_SIZE, LIGHT_KG = np.r_[1.0, np.full(3, 0.1), np.full(6, 0.01)], 0.1
# The place of XX XY XZ YY YZ ZZ in a symmetric 3x3 matrix.
_ROWS = (0, 0, 0, 1, 1, 2)
_COLS = (0, 1, 2, 1, 2, 2)
# Smallest pseudo-inertia eigenvalue that counts as positive, relative to the largest: a body
# closer to impossible than rounding error can't be told from an impossible one.
CONSISTENCY_TOLERANCE = 1e-12


def tensor_from_six(six: ArrayLike) -> Array:
    """Symmetric (..., 3, 3) matrices of (..., 6) elements XX XY XZ YY YZ ZZ."""
    s = np.asarray(six, dtype=np.float64)
    out = np.empty((*s.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(zip(_ROWS, _COLS, strict=True)):
        out[..., i, j] = out[..., j, i] = s[..., k]
    return out


def six_from_tensor(tensor: ArrayLike) -> Array:
    """The (..., 6) elements XX XY XZ YY YZ ZZ of symmetric (..., 3, 3) matrices."""
    return np.asarray(np.asarray(tensor, dtype=np.float64)[..., _ROWS, _COLS])


def pseudo_inertia(theta: ArrayLike) -> Array:
    """(..., 4, 4) pseudo-inertia [[½ tr(I) 1 - I, h], [hᵀ, m]] of (..., 10) parameters."""
    t = np.asarray(theta, dtype=np.float64)
    tensor = tensor_from_six(t[..., 4:])
    out = np.empty((*t.shape[:-1], 4, 4))
    trace = np.trace(tensor, axis1=-2, axis2=-1)[..., None, None]
    out[..., :3, :3] = 0.5 * trace * np.eye(3) - tensor
    out[..., :3, 3] = out[..., 3, :3] = t[..., 1:4]
    out[..., 3, 3] = t[..., 0]
    return out


def theta_from_pseudo_inertia(pseudo: ArrayLike) -> Array:
    """(..., 10) parameters of (..., 4, 4) pseudo-inertias; inverse of `pseudo_inertia`."""
    j = np.asarray(pseudo, dtype=np.float64)
    second = j[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)[..., None, None]
    tensor = trace * np.eye(3) - second
    return np.concatenate([j[..., 3, 3:], j[..., :3, 3], six_from_tensor(tensor)], axis=-1)


def min_eigenvalue(theta: ArrayLike) -> Array:
    """Smallest eigenvalue (...) of the pseudo-inertia of (..., 10) parameters."""
    return np.asarray(np.linalg.eigvalsh(pseudo_inertia(theta))[..., 0], dtype=np.float64)


def is_consistent(theta: ArrayLike, tolerance: float = 0.0) -> bool:
    """Whether every one of (..., 10) bodies is possible: all eigenvalues above -`tolerance`.

    With the default, rods and point masses (semidefinite, an eigenvalue of 0) are refused.
    """
    t = np.asarray(theta, dtype=np.float64)
    return bool(np.all(np.isfinite(t)) and np.all(min_eigenvalue(t) > -tolerance))


def theta_from_body(mass: ArrayLike, com: ArrayLike, tensor_at_com: ArrayLike) -> Array:
    """(..., 10) parameters from mass (...), centre (..., 3) and inertia about it (..., 3, 3)."""
    m = np.asarray(mass, dtype=np.float64)
    c = np.asarray(com, dtype=np.float64)
    cross = skew(c)
    tensor = np.asarray(tensor_at_com) - m[..., None, None] * (cross @ cross)
    return np.concatenate([m[..., None], m[..., None] * c, six_from_tensor(tensor)], axis=-1)


def body_from_theta(theta: ArrayLike) -> tuple[Array, Array, Array]:
    """Mass (...), centre (..., 3) and inertia about it (..., 3, 3); centre 0 where massless."""
    t = np.asarray(theta, dtype=np.float64)
    m = t[..., 0]
    c = t[..., 1:4] / np.where(m == 0.0, 1.0, m)[..., None]
    cross = skew(c)
    return m, c, tensor_from_six(t[..., 4:]) + m[..., None, None] * (cross @ cross)


def move_theta(theta: ArrayLike, rotation: ArrayLike, position: ArrayLike) -> Array:
    """Parameters (..., 10) of a body given in frame B, in frame A: R_AB, origin of B in A."""
    transform = np.zeros((4, 4))
    transform[:3, :3] = rotation
    transform[:3, 3] = position
    transform[3, 3] = 1.0
    return theta_from_pseudo_inertia(transform @ pseudo_inertia(theta) @ transform.T)


def log_cholesky_from_theta(theta: ArrayLike) -> Array:
    """Log-Cholesky vectors (..., 10) of (..., 10) parameters: J = U Uᵀ, U upper triangular.

    Back again: `physics.networks.theta_from_log_cholesky`.

    Raises:
        ValueError: where a body is impossible (`is_consistent` is false).
    """
    pseudo = pseudo_inertia(theta)
    try:
        lower = np.linalg.cholesky(pseudo[..., ::-1, ::-1])
    except np.linalg.LinAlgError:
        worst = float(np.min(min_eigenvalue(theta)))
        raise ValueError(
            f"body without positive definite pseudo-inertia (eigenvalue {worst:.3g})"
        ) from None
    upper = lower[..., ::-1, ::-1]
    scale = upper[..., 3, 3]
    unit = upper / scale[..., None, None]
    diagonal = np.log(unit[..., (0, 1, 2), (0, 1, 2)])
    sides = unit[..., (0, 1, 0), (1, 2, 2)]
    return np.concatenate([np.log(scale)[..., None], diagonal, sides, unit[..., :3, 3]], axis=-1)
