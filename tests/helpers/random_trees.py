"""Trees of random shape for the simulator of falls."""

from __future__ import annotations

import numpy as np

from sim.falls.fall import BASE, TreeLimits, TreeTruth
from sim.truth import Array, theta_of, turn

GRAVITY = (0.0, 0.0, -9.81)  # m/s², world axes
FEWEST, MOST = 5, 60  # links of a random tree
NEAR = 16  # a random tree's link hangs on one of so many before it: chains as well as branches
REACH_M = 0.12  # rms distance between two joints of a random tree, per axis
DENSITY = 1000.0  # kg/m³, of the boxes that random links are made of (water; robots are close)
SHORTEST_M, LONGEST_M = 0.05, 0.2  # edges of those boxes
RANGE_RAD, SPEED, EFFORT = (0.8, 2.0), 12.0, 1000.0  # rad, rad/s, N m: ATLAS has the like


def random_tree(links: int, seed: int) -> TreeTruth:
    """A tree of random shape: boxes of water's density, joined anywhere, turning about any axis.

    Args:
        links: moving ones, 5 to 60.
        seed: same seed, same tree.

    Raises:
        ValueError: fewer or more links than that.
    """
    if not FEWEST <= links <= MOST:
        raise ValueError(f"a random tree has {FEWEST} to {MOST} moving links, got {links}")
    rng = np.random.default_rng([seed, links])
    parent = tuple(int(rng.integers(max(BASE, k - NEAR), k)) for k in range(links))
    half = rng.uniform(*RANGE_RAD, links)
    middle = rng.uniform(-0.5, 0.5, links)
    everywhere = np.ones(links)
    return TreeTruth(
        name=f"tree{links}",
        joint_names=tuple(f"joint{k + 1}" for k in range(links)),
        link_names=tuple(f"link{k + 1}" for k in range(links)),
        base_name="base",
        parent=parent,
        R=np.array([_any_rotation(rng) for _ in range(links)]),
        p=REACH_M * rng.standard_normal((links, 3)),
        theta=np.array([_random_body(rng) for _ in range(links + 1)]),
        limits=TreeLimits(middle - half, middle + half, SPEED * everywhere, EFFORT * everywhere),
        gravity=np.array(GRAVITY),
    )


def _random_body(rng: np.random.Generator) -> Array:
    """(10,) of a box of random size, place and orientation."""
    edges = rng.uniform(SHORTEST_M, LONGEST_M, 3)
    m = DENSITY * float(np.prod(edges))
    axes = _any_rotation(rng)
    square = edges * edges
    inertia = axes @ np.diag(m / 12 * (square.sum() - square)) @ axes.T
    com = REACH_M / 2 * rng.standard_normal(3)
    return theta_of(m, com.tolist(), inertia[np.triu_indices(3)].tolist())


def _any_rotation(rng: np.random.Generator) -> Array:
    """A rotation (3, 3), uneven but full in its range: three turns by any angle."""
    first, second, third = rng.uniform(-np.pi, np.pi, 3)
    return turn(2, first) @ turn(0, second) @ turn(2, third)
