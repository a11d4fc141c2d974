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

from adapter.errors import ModelError
from adapter.learning.batch.theta_factors import (
    PER_BODY,
    RowFactor,
    row_factors,
    scales,
    system,
)
from adapter.learning.batch.theta_solvers import (
    Solution,
    adam_theta,
    consistent_theta,
    least_squares_theta,
    random_bodies,
)
from adapter.learning.tree_data import TreeData
from adapter.model.inertia import (
    is_consistent,
    log_cholesky_from_theta,
    min_eigenvalue,
)
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree
from adapter.physics.networks import theta_from_log_cholesky

SOLVERS = ("consistent", "least squares", "adam")
# Residuals are not trusted below this share of a row's size when they set its weight; without a
# floor, rounds of weighting end with the rows that happen to fit best deciding alone.
RESIDUAL_FLOOR = 1e-4
# Weights that move by less than this share in a round have settled.
SETTLED_WEIGHTS = 0.1

_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_LIMBS = {
    "leg": "leg",
    "foot": "leg",
    "knee": "leg",
    "hip": "leg",
    "ankle": "leg",
    "arm": "arm",
    "hand": "arm",
    "wrist": "arm",
    "elbow": "arm",
    "shoulder": "arm",
}


@dataclass(frozen=True)
class Branch:
    """One branch on the base.

    Attributes:
        name: "right leg", "left leg", "upper body", ... where names fit, else "branch k".
        joints: indices of its joints (and moving links) in the whole tree, parents first.
        tree: the branch alone, on a base whose motion is given (`floating` false); its joint k
            is joint `joints[k]` of the whole.
    """

    name: str
    joints: tuple[int, ...]
    tree: Tree


def branches(tree: Tree) -> tuple[Branch, ...]:
    """One branch for each child of the base, in the order of the tree."""
    first = {j: j for j, i in enumerate(tree.parent) if i == BASE}
    for j, i in enumerate(tree.parent):
        if i != BASE:
            first[j] = first[i]
    groups = [tuple(j for j in range(tree.n) if first[j] == k) for k in sorted(set(first.values()))]
    names = [_name(tree, joints) for joints in groups]
    found = []
    for k, (name, joints) in enumerate(zip(names, groups, strict=True)):
        if name is None or names.count(name) > 1:
            name = f"branch {k + 1}"
        found.append(Branch(name, joints, _alone(tree, joints)))
    return tuple(found)


def _alone(tree: Tree, joints: tuple[int, ...]) -> Tree:
    """The branch as a tree of its own."""
    place = {BASE: BASE} | {j: k for k, j in enumerate(joints)}
    return Tree(
        tuple(place[tree.parent[j]] for j in joints),
        False,
        tuple(tree.joint_names[j] for j in joints),
        tuple(tree.link_names[j] for j in joints),
        tree.base_name,
    )


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
class BatchThetaSettings:
    """How θ is found.

    Attributes:
        solver: "consistent" (possible bodies, by a conic interior point), "least squares"
            (base parameters, nearest to the prior), or "adam" (possible bodies, by descent).
        supervision: "torques", "wrenches" or "both" (eq. 17).
        std: standard deviation of every row of `row_factors`, N or N m. None: the size of its
            signal first, then what the first solve leaves of it.
        rounds: most rounds of weighting by what is left, where `std` is None; fewer once no weight
            moves by more than a tenth.
        whole: whether all bodies are solved together in the end; without it a floating base
            keeps its start.
        prior: (bodies, 10), for "least squares"; zeros where None.
        adam_steps: for "adam".
    """

    solver: str = "consistent"
    supervision: str = "torques"
    std: tuple[float, ...] | None = None
    rounds: int = 5
    whole: bool = True
    prior: Array | None = None
    adam_steps: int = 5000

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise ModelError(f"no solver '{self.solver}'; have: {', '.join(SOLVERS)}")
        if self.std is not None and not all(0.0 < s < np.inf for s in self.std):
            raise ModelError("every standard deviation must be above zero and finite")


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
        residual: by name of row, root mean square of what is left, N or N m.
        std: the weights' standard deviations by row.
        min_eigenvalue: smallest of all pseudo-inertias; above zero: every body is possible.
        converged: whether the last solve of every body did; if not, θ is the best found and may
            be far from what the data say.
    """

    theta: Array
    rank: int
    stages: tuple[Stage, ...]
    residual: dict[str, float]
    std: dict[str, float]
    min_eigenvalue: float
    converged: bool


def learn_theta(
    data: TreeData,
    lam: Array,
    seed: int = 0,
    settings: BatchThetaSettings | None = None,
    wrenches: Array | None = None,
) -> ThetaResult:
    """θ from samples.

    Args:
        data: joint signals, torques, and the base's motion (rest and -gravity where it is fixed).
        lam: (n, 6) λ.
        seed: of the random bodies that "adam" starts from.
        settings: see `BatchThetaSettings`.
        wrenches: (m, bodies, 6), where they are measured (eq. 15).

    Raises:
        ModelError: unknown names, shapes that don't fit, numbers that are not finite.
    """
    settings = settings or BatchThetaSettings()
    rows = row_factors(data, lam, settings.supervision, wrenches)
    solve = _Solve(data, rows, settings, np.random.default_rng(seed))
    solve.run()
    for _ in range(settings.rounds if settings.std is None else 0):
        floor, before = RESIDUAL_FLOOR * scales(rows), solve.std
        solve.std = np.maximum([row.residual(solve.theta) for row in rows], floor)
        if np.abs(solve.std / before - 1.0).max() < SETTLED_WEIGHTS:
            break
        solve.again()
    names = [row.name for row in rows]
    least = float(min_eigenvalue(solve.theta).min())
    possible = least > 0.0 or settings.solver == "least squares"
    left = [row.residual(solve.theta) for row in rows]
    return ThetaResult(
        theta=solve.theta,
        rank=solve.rank(tuple(range(data.tree.bodies))),
        stages=tuple(solve.stages),
        residual=dict(zip(names, left, strict=True)),
        std=dict(zip(names, solve.std.tolist(), strict=True)),
        min_eigenvalue=least,
        converged=possible and all(solve.converged.values()),
    )


class _Solve:
    """The sub-problems of one tree, and the θ that they fill."""

    def __init__(
        self,
        data: TreeData,
        rows: list[RowFactor],
        settings: BatchThetaSettings,
        rng: np.random.Generator,
    ) -> None:
        self.tree, self.rows, self.settings = data.tree, rows, settings
        self.std = scales(rows) if settings.std is None else np.array(settings.std)
        if len(self.std) != len(rows):
            raise ModelError(f"{len(rows)} rows need as many std, got {len(self.std)}")
        self.start = random_bodies(self.tree.bodies, rng)
        self.theta = theta_from_log_cholesky(self.start)
        if settings.solver == "least squares":
            prior = np.zeros_like(self.theta) if settings.prior is None else settings.prior
            if prior.shape != self.theta.shape:
                raise ModelError(f"the prior of θ must have shape {self.theta.shape}")
            self.theta = np.array(prior, dtype=float)
        self.stages: list[Stage] = []
        self.converged: dict[int, bool] = {}  # by body, of its last solve

    def run(self) -> None:
        """Branches, then the whole."""
        first = int(self.tree.floating)
        for branch in branches(self.tree):
            self._stage(branch.name, tuple(j + first for j in branch.joints))
        self.again()

    def again(self) -> None:
        """All bodies together, from where they are."""
        if self.settings.whole:
            self._stage("whole tree", tuple(range(self.tree.bodies)))

    def rank(self, bodies: tuple[int, ...]) -> int:
        """Base parameters that the rows of these bodies show."""
        r, b = self._system(bodies)
        return least_squares_theta(r, b, self.theta[list(bodies)]).rank or 0

    def _system(self, bodies: tuple[int, ...]) -> tuple[Array, Array]:
        """R θ = b of some bodies, from the rows that see no others."""
        chosen = set(bodies)
        pairs = zip(self.rows, self.std, strict=True)
        own = [(row, sigma) for row, sigma in pairs if set(row.bodies) <= chosen]
        if not own:
            raise ModelError("no row shows these bodies")
        return system([row for row, _ in own], np.array([s for _, s in own]), bodies)

    def _stage(self, name: str, bodies: tuple[int, ...]) -> None:
        began = time.perf_counter()
        r, b = self._system(bodies)
        at = list(bodies)
        found = self._solve(r, b, self.theta[at], self.start[at])
        self.theta[at] = found.theta
        rank = found.rank if found.rank is not None else self.rank(bodies)
        wall = time.perf_counter() - began
        size = PER_BODY * len(bodies)
        self.stages.append(
            Stage(name, bodies, rank, size, found.cost, found.steps, wall, found.converged)
        )
        self.converged |= dict.fromkeys(bodies, found.converged)

    def _solve(self, r: Array, b: Array, now: Array, start: Array) -> Solution:
        if self.settings.solver == "least squares":
            return least_squares_theta(r, b, now)
        if self.settings.solver == "consistent":
            return consistent_theta(r, b)
        vectors = log_cholesky_from_theta(now) if is_consistent(now) else start
        return adam_theta(r, b, vectors, self.settings.adam_steps)
