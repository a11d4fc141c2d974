"""Rotations and small vector algebra in numpy, batched over leading dimensions.

R_ij takes the coordinates of a vector in frame j to those in frame i. Angles in rad.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Below this sine the two z-turns of a z-x-z triple can't be told apart; one of them is set to 0.
EULER_SINGULAR_SINE = 1e-12


def at_joints(R0: Array, p: Array, q: ArrayLike, slides: ArrayLike) -> tuple[Array, Array]:
    """Frames of joints (..., 3, 3), (..., 3) at zero, where the joints stand at q (...), rad or m.

    Args:
        slides: (...) bool, joints that slide along their z; the others turn about it.
    """
    along = np.where(slides, q, 0.0)
    turned: Array = R0 @ rot_z(np.where(slides, 0.0, q))
    return turned, np.asarray(p + R0[..., :, 2] * along[..., None])


def skew(vector: ArrayLike) -> Array:
    """The matrix [x ×] of (..., 3) vectors, (..., 3, 3): skew(a) @ b = a × b."""
    v = np.asarray(vector, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _turn(angle: ArrayLike, fixed: int) -> Array:
    """Rotation about the coordinate axis number `fixed`, (..., 3, 3)."""
    a = np.asarray(angle, dtype=np.float64)
    i, j = (fixed + 1) % 3, (fixed + 2) % 3
    out = np.zeros((*a.shape, 3, 3))
    out[..., fixed, fixed] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(a)
    out[..., j, i] = np.sin(a)
    out[..., i, j] = -out[..., j, i]
    return out


def rot_x(angle: ArrayLike) -> Array:
    """Rotation about x by (...) angles, (..., 3, 3)."""
    return _turn(angle, 0)


def rot_y(angle: ArrayLike) -> Array:
    """Rotation about y by (...) angles, (..., 3, 3)."""
    return _turn(angle, 1)


def rot_z(angle: ArrayLike) -> Array:
    """Rotation about z by (...) angles, (..., 3, 3)."""
    return _turn(angle, 2)


def matrix_from_zxz(angles: ArrayLike) -> Array:
    """Rz(α) Rx(β) Rz(γ) of (..., 3) angles [α β γ] (paper, eq. 9 at q = 0), (..., 3, 3)."""
    e = np.asarray(angles, dtype=np.float64)
    return np.asarray(rot_z(e[..., 0]) @ rot_x(e[..., 1]) @ rot_z(e[..., 2]))


def zxz_from_matrix(rotation: ArrayLike) -> Array:
    """Canonical angles [α β γ] of (..., 3, 3) rotations: β in [0, π]; γ = 0 where β is 0 or π.

    γ is read from what Rz(α) Rx(β) leaves over, so the rotation is met to rounding error even
    close to the singularity, where α alone is poorly determined.
    """
    r = np.asarray(rotation, dtype=np.float64)
    sine = np.hypot(r[..., 0, 2], r[..., 1, 2])
    singular = sine < EULER_SINGULAR_SINE
    beta = np.arctan2(np.where(singular, 0.0, sine), r[..., 2, 2])
    alpha = np.where(
        singular, np.arctan2(r[..., 1, 0], r[..., 0, 0]), np.arctan2(r[..., 0, 2], -r[..., 1, 2])
    )
    rest = np.swapaxes(rot_z(alpha) @ rot_x(beta), -1, -2) @ r
    gamma = np.where(singular, 0.0, np.arctan2(rest[..., 1, 0], rest[..., 0, 0]))
    return np.stack([alpha, beta, gamma], axis=-1)


def exp_rotation(vector: ArrayLike) -> Array:
    """Rotation matrices of (..., 3) rotation vectors (axis times angle), (..., 3, 3)."""
    v = np.asarray(vector, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    # sinc keeps both series factors exact at zero: sin(x)/x and (1 - cos x)/x² = ½ sinc²(x/2).
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def log_rotation(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3) of (..., 3, 3) rotations, angle in [0, π]."""
    from scipy.spatial.transform import Rotation

    r = np.asarray(rotation, dtype=np.float64)
    vectors = Rotation.from_matrix(r.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vectors.reshape(r.shape[:-1]))


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Unit quaternions [w x y z] (..., 4) of rotations (..., 3, 3), w not below zero."""
    from scipy.spatial.transform import Rotation

    r = np.asarray(rotation, dtype=np.float64)
    xyzw = Rotation.from_matrix(r.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.roll(xyzw, 1, axis=-1).reshape(*r.shape[:-2], 4)


def quaternion_product(a: ArrayLike, b: ArrayLike) -> Array:
    """Quaternions [w x y z] (..., 4) of the rotation b followed by the rotation a."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    w, v, x, u = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = w * x - np.sum(v * u, axis=-1, keepdims=True)
    return np.concatenate([real, w * u + x * v + np.cross(v, u)], axis=-1)


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """The rotation (3, 3) of a quaternion [w x y z] (4,) of any length."""
    w, *xyz = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    k = skew(xyz)
    return np.asarray(np.eye(3) + 2.0 * w * k + 2.0 * (k @ k))


def rotation_angle(first: ArrayLike, second: ArrayLike) -> Array:
    """Angle (...) between two sets of (..., 3, 3) rotations, rad."""
    relative = np.swapaxes(np.asarray(first, dtype=np.float64), -1, -2) @ np.asarray(second)
    return np.asarray(np.linalg.norm(log_rotation(relative), axis=-1))


def z_to_axis(axis: ArrayLike) -> Array:
    """The smallest rotation Q (3, 3) that turns z to `axis`: Q z = axis / |axis|.

    For axis = -z it is not unique; the turn by π about x is taken. This is the rule by which
    joint frames of any axis become frames turning about z, and back.

    >>> z_to_axis([0, 0, -1]).diagonal().tolist()
    [1.0, -1.0, -1.0]
    """
    u = np.asarray(axis, dtype=np.float64)
    u = u / np.linalg.norm(u)
    sine = float(np.hypot(u[0], u[1]))
    if sine < 1e-290:  # nothing, or subnormal numbers, which have lost its direction
        return np.eye(3) if u[2] > 0 else np.diag([1.0, -1.0, -1.0])
    k = skew([-u[1] / sine, u[0] / sine, 0.0])
    return np.asarray(np.eye(3) + sine * k + (1.0 - u[2]) * (k @ k))


def matrix_from_rpy(rpy: ArrayLike) -> Array:
    """URDF's fixed-axis roll, pitch, yaw (..., 3) as Rz(yaw) Ry(pitch) Rx(roll), (..., 3, 3)."""
    a = np.asarray(rpy, dtype=np.float64)
    return np.asarray(rot_z(a[..., 2]) @ rot_y(a[..., 1]) @ rot_x(a[..., 0]))


def rpy_from_matrix(rotation: ArrayLike) -> Array:
    """Roll, pitch in [-π/2, π/2] and yaw (..., 3) of (..., 3, 3) rotations.

    Roll is read from what Rz(yaw) Ry(pitch) leaves over, which stays exact at pitch = ±π/2.
    """
    r = np.asarray(rotation, dtype=np.float64)
    cosine = np.hypot(r[..., 0, 0], r[..., 1, 0])
    singular = cosine < EULER_SINGULAR_SINE
    yaw = np.where(singular, 0.0, np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    pitch = np.arctan2(-r[..., 2, 0], np.where(singular, 0.0, cosine))
    rest = np.swapaxes(rot_z(yaw) @ rot_y(pitch), -1, -2) @ r
    roll = np.arctan2(rest[..., 2, 1], rest[..., 1, 1])
    return np.stack([roll, pitch, yaw], axis=-1)


def vector3(value: Any) -> Array:
    """A (3,) float64 vector from anything array-like. Raises ValueError on another shape."""
    v = np.asarray(value, dtype=np.float64)
    if v.shape != (3,) or not np.all(np.isfinite(v)):
        raise ValueError(f"expected 3 finite numbers, got {value!r}")
    return v
