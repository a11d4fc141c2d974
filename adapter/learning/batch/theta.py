"""θ of a whole tree: the branches that the topology dictates, then all together with the base.

With λ known and the base's motion measured, the joint torques of a branch depend on its own
bodies alone (paper, section III-B). They leave three combinations of each link open, which act
on the link below and in the end on the base; a last solve over all bodies, the base for the
first time among them, makes what the branches left open fit one possible robot. (A base solved
alone would have to make up for what the branches left open, which no possible body can.)
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass

import numpy as np

from adapter.learning.batch.theta_factors import row_factors, scales, system
from adapter.learning.batch.theta_solvers import consistent_theta, least_squares_theta
from adapter.learning.tree_data import TreeData
from adapter.model.inertia import min_eigenvalue
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree

ROUNDS = 5  # of weighting by what is left, at most

_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_LIMBS = dict.fromkeys(("leg", "foot", "knee", "hip", "ankle"), "leg")
_LIMBS |= dict.fromkeys(("arm", "hand", "wrist", "elbow", "shoulder"), "arm")


def branches(tree: Tree) -> dict[str, tuple[int, ...]]:
    """Joints (and moving links) of each branch on the base, parents first, in the tree's order.

    By name: "right leg", "left leg", "upper body", ... where names fit, else "branch k".
    """
    first = {j: j for j, i in enumerate(tree.parent) if i == BASE}
    for j, i in enumerate(tree.parent):
        if i != BASE:
            first[j] = first[i]
    groups = [tuple(j for j in range(tree.n) if first[j] == k) for k in sorted(set(first.values()))]
    names = [_name(tree, joints) for joints in groups]
    return {
        f"branch {k}" if name is None or names.count(name) > 1 else name: joints
        for k, (name, joints) in enumerate(zip(names, groups, strict=True), 1)
    }


def _name(tree: Tree, joints: tuple[int, ...]) -> str | None:
    """Limb and side where every link names the same side; both sides' limbs: the upper body."""
    words = [_words(f"{tree.joint_names[j]} {tree.link_names[j]}") for j in joints]
    sides = [{_SIDES[word] for word in own if word in _SIDES} for own in words]
    limbs = {_LIMBS[word] for own in words for word in own if word in _LIMBS}
    named = set().union(*sides)
    if len(limbs) == 1 and len(named) == 1 and all(sides):
        return f"{named.pop()} {limbs.pop()}"
    return "upper body" if limbs == {"arm"} and len(named) == 2 else None


def _words(name: str) -> set[str]:
    """Lower-case words of a name; `l_uleg` and `leftLeg` speak of a leg too."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower()
    words = {word for word in re.split(r"[^a-z]+", spaced) if word}
    return words | {limb for limb in _LIMBS for word in words if word.endswith(limb)}


@dataclass(frozen=True)
class Stage:
    """One solved sub-problem.

    Attributes:
        name: of the branch, or "whole tree".
        bodies: rows of θ that it solved.
        rank: base parameters that its rows show; parameters: 10 per body.
        cost: half the weighted sum of squares left; steps: of the solver.
        wall_s: time it took.
        converged: whether the cost is known to be the least there is (`Solution`).
    """

    name: str
    bodies: tuple[int, ...]
    rank: int
    parameters: int
    cost: float
    steps: int
    wall_s: float
    converged: bool


@dataclass(frozen=True)
class ThetaResult:
    """θ and how it came about.

    Attributes:
        theta: (bodies, 10), base first if it floats.
        rank: base parameters that all rows together show.
        stages: in the order they were solved.
        std: by name of row, the standard deviations of the weights, N or N m.
        min_eigenvalue: smallest of all pseudo-inertias; above zero: every body is possible.
        converged: whether the last solve did; if not, θ is the best found and may be far from
            what the data say.
    """

    theta: Array
    rank: int
    stages: tuple[Stage, ...]
    std: dict[str, float]
    min_eigenvalue: float
    converged: bool


def learn_theta(
    data: TreeData, lam: Array, possible: bool = True, rounds: int = ROUNDS
) -> ThetaResult:
    """θ from samples.

    Rows are weighted by the size of their signal first, then by what the solve before left of it.

    Args:
        data: joint signals, torques, and the base's motion (rest and -gravity where it is fixed).
        lam: (n, 6) λ.
        possible: over possible bodies, by a conic interior point; else base parameters by least
            squares, the nearest to zero.
        rounds: most rounds of weighting by what is left; fewer once no weight moves by more than
            a tenth.

    Raises:
        ModelError: shapes that don't fit, numbers that are not finite.
    """
    rows, tree = row_factors(data, lam), data.tree
    std, theta, stages = scales(rows), np.zeros((tree.bodies, 10)), list[Stage]()

    def solve(name: str, bodies: tuple[int, ...]) -> None:
        """Solve for some bodies from the rows that see no others."""
        began, at = time.perf_counter(), list(bodies)
        own = [k for k, row in enumerate(rows) if set(row.bodies) <= set(bodies)]
        r, b = system([rows[k] for k in own], std[own], bodies)
        found = consistent_theta(r, b) if possible else least_squares_theta(r, b, theta[at])
        theta[at] = found.theta
        wall_s = time.perf_counter() - began
        told = found.rank, 10 * len(bodies), found.cost, found.steps, wall_s, found.converged
        stages.append(Stage(name, bodies, *told))

    for name, joints in branches(tree).items():
        solve(name, tuple(j + int(tree.floating) for j in joints))
    whole = "whole tree", tuple(range(tree.bodies))
    solve(*whole)
    for _ in range(rounds):
        # Residuals are not trusted below this share of a row's size when they set its weight;
        # without a floor, rounds of weighting end with the rows that happen to fit best deciding
        # alone.
        floor, before = 1e-4 * scales(rows), std
        std = np.maximum([row.residual(theta) for row in rows], floor)
        # Weights that move by less than this share in a round have settled.
        if np.abs(std / before - 1.0).max() < 0.1:
            break
        solve(*whole)
    least = float(min_eigenvalue(theta).min())
    return ThetaResult(
        theta=theta,
        rank=stages[-1].rank,
        stages=tuple(stages),
        std={row.name: float(s) for row, s in zip(rows, std, strict=True)},
        min_eigenvalue=least,
        converged=(least > 0.0 or not possible) and stages[-1].converged,
    )
