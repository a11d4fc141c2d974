"""Random trees: for the simulator of falls, and as CAD draws them.

Those have right angles and half turns between frames, and axes that meet.
"""

from __future__ import annotations

import numpy as np

from adapter.learning.theta import neutral_body
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, rot_x, rot_y, rot_z, zxz_from_matrix
from adapter.model.tree import Tree
from sim.falls.fall import BASE, TreeTruth
from sim.truth import Array, Limits, theta_of, turn

MOST_JOINTS = 30
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
    if rng.random() < 0.25:  # stand at any angle; the others at right angles
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


GRAVITY = (0.0, 0.0, -9.81)  # m/s², world axes
NEAR = 16  # a random tree's link hangs on one of so many before it: chains as well as branches
REACH_M = 0.12  # rms distance between two joints of a random tree, per axis
RANGE_RAD, SPEED, EFFORT = (0.8, 2.0), 12.0, 1000.0  # rad, rad/s, N m: ATLAS has the like


def random_tree(links: int, seed: int) -> TreeTruth:
    """A tree of random shape: boxes of water's density, joined anywhere, turning about any axis.

    Args:
        links: moving ones.
        seed: same seed, same tree.
    """
    rng = np.random.default_rng([seed, links])
    parent = tuple(int(rng.integers(max(BASE, k - NEAR), k)) for k in range(links))
    half = rng.uniform(*RANGE_RAD, links)
    middle = rng.uniform(-0.5, 0.5, links)
    speed, effort, free = (np.full(links, x) for x in (SPEED, EFFORT, np.inf))
    return TreeTruth(
        name=f"tree{links}",
        joint_names=tuple(f"joint{k + 1}" for k in range(links)),
        link_names=tuple(f"link{k + 1}" for k in range(links)),
        base_name="base",
        parent=parent,
        R=np.array([_any_rotation(rng) for _ in range(links)]),
        p=REACH_M * rng.standard_normal((links, 3)),
        theta=np.array([_random_body(rng) for _ in range(links + 1)]),
        limits=Limits(middle - half, middle + half, speed, effort, free),
        gravity=np.array(GRAVITY),
    )


def _random_body(rng: np.random.Generator) -> Array:
    """(10,) of a box of random size, place and orientation."""
    edges = rng.uniform(0.05, 0.2, 3)  # m
    m = 1000.0 * float(np.prod(edges))  # of water; robots are close
    axes = _any_rotation(rng)
    square = edges * edges
    inertia = axes @ np.diag(m / 12 * (square.sum() - square)) @ axes.T
    com = REACH_M / 2 * rng.standard_normal(3)
    return theta_of(m, com.tolist(), inertia[np.triu_indices(3)].tolist())


def _any_rotation(rng: np.random.Generator) -> Array:
    """A rotation (3, 3), uneven but full in its range: three turns by any angle."""
    first, second, third = rng.uniform(-np.pi, np.pi, 3)
    return turn(2, first) @ turn(0, second) @ turn(2, third)
