"""Random trees as CAD draws them: right angles and half turns between frames, axes that meet."""

from __future__ import annotations

import numpy as np

from adapter.learning.theta import neutral_body
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, rot_x, rot_y, rot_z, zxz_from_matrix
from adapter.model.tree import Tree

MOST_JOINTS = 30
ANY_ANGLE = 0.25  # share of frames that stand at any angle; the others at right angles
NO_OFFSET, ALONG_AN_AXIS = 0.2, 0.5  # shares of origins


def cad_tree(seed: int, joints: int | None = None) -> SelfModel:
    """A tree of 2 to 30 joints on a fixed base.

    Args:
        seed: of everything.
        joints: how many; any number where None.
    """
    rng = np.random.default_rng([seed, 17])
    n = int(rng.integers(2, MOST_JOINTS + 1)) if joints is None else joints
    reach = int(rng.integers(1, 5))  # 1: a chain
    parent = [-1, *(int(rng.integers(max(0, j - reach), j)) for j in range(1, n))]
    lam = np.array([np.r_[zxz_from_matrix(_rotation(rng)), _offset(rng)] for _ in range(n)])
    theta = np.tile(neutral_body(), (n, 1))
    return SelfModel(f"cad{seed}", Tree(tuple(parent)), lam, theta)


def _rotation(rng: np.random.Generator) -> np.ndarray:
    if rng.random() < ANY_ANGLE:
        return exp_rotation(rng.uniform(0.0, np.pi) * _direction(rng))
    quarter = 0.5 * np.pi * rng.integers(0, 4, 3)
    return rot_z(quarter[0]) @ rot_y(quarter[1]) @ rot_x(quarter[2])


def _direction(rng: np.random.Generator) -> np.ndarray:
    x = rng.normal(size=3)
    return np.asarray(x / np.linalg.norm(x))


def _offset(rng: np.random.Generator) -> np.ndarray:
    kind, length = rng.random(), rng.uniform(0.02, 0.5)
    if kind < NO_OFFSET:
        return np.zeros(3)
    if kind < NO_OFFSET + ALONG_AN_AXIS:
        return length * float(rng.choice([-1.0, 1.0])) * np.eye(3)[rng.integers(3)]
    return length * _direction(rng)
