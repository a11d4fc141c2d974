"""One sub-chain of a tree as a table of inputs and outputs for learners that know no robot.

The torques of an arm are a function of its own q, dq, ddq and of the motion of the link that
carries it: its angular velocity and its acceleration with gravity. So the task is well-posed,
whatever the rest of the robot does. They do not depend on the linear velocity v of that link
(Galilei): v is in the paper's list of inputs (twist), but would only add three columns of
nuisance; in free fall it says how long the fall has lasted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.experiments.baselines.learner import checked
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree


@dataclass(frozen=True)
class Columns:
    """Which column of X is what: q, dq, ddq (n each), then w, a, dw of the carrier (3 each).

    Attributes:
        n: number of joints of the sub-chain.
    """

    n: int

    @property
    def width(self) -> int:
        """Number of columns of X."""
        return 3 * self.n + 9

    def check(self, x: Array, y: Array) -> None:
        """Raises ModelError where X has other columns, or Y not one by joint."""
        checked(x, width=self.width)
        if y.shape[1] != self.n:
            raise ModelError(f"Y must have {self.n} columns, got {y.shape[1]}")

    def joints(self, x: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (m, n) of X."""
        n = self.n
        return x[:, :n], x[:, n : 2 * n], x[:, 2 * n : 3 * n]

    def carrier(self, x: Array) -> BodyMotion:
        """Motion (m, 3) of the link that carries the sub-chain."""
        w, a, dw = (x[:, 3 * self.n + 3 * k : 3 * self.n + 3 * k + 3] for k in range(3))
        return BodyMotion(w, a, dw)


def arm_problem(data: TreeData, joints: Sequence[str], carrier: str) -> tuple[Array, Array]:
    """Inputs X (m, width, see `Columns`) and torques Y (m, joints) of a sub-chain.

    Args:
        data: samples of the whole tree, with measured motion of the links.
        joints: names of the sub-chain's joints, from the carrier outwards; with everything that
            hangs on them, or the torques would depend on what X does not hold.
        carrier: name of the link (or base) that carries them; its motion is in its own frame.

    Raises:
        ModelError: joints that are no such sub-chain of that carrier, or samples that are not
            finite.
    """
    index = sub_chain(data.tree, joints, carrier)
    link, links = data.tree.parent[index[0]], data.links
    motion = [data.base.w, data.base.a, data.base.dw]
    if link != BASE:
        assert links is not None
        motion = [links.w[:, link], links.a[:, link], links.dw[:, link]]
    first = data.tree.rows - data.tree.n
    x = np.concatenate([data.q[:, index], data.dq[:, index], data.ddq[:, index], *motion], axis=1)
    y = data.tau[:, first + index]
    return checked(x, y), y


def sub_chain(tree: Tree, joints: Sequence[str], carrier: str) -> np.ndarray:
    """Indices (n,) of the joints, checked to be all that hangs on the first. See `arm_problem`."""
    index = [tree.joint_index(name) for name in joints]
    if not index:
        raise ModelError(f"no joints named; have: {', '.join(tree.joint_names)}")
    bodies = (tree.base_name, *tree.link_names)
    on = bodies[tree.parent[index[0]] + 1]
    if carrier != on:
        raise ModelError(f"joint '{joints[0]}' hangs on link '{on}', not on '{carrier}'")
    inside = [j for j in range(tree.n) if index[0] in tree.path_to(j)]
    if sorted(index) != inside or any(
        tree.parent[j] not in index[:k] for k, j in enumerate(index) if k
    ):
        needed = ", ".join(tree.joint_names[j] for j in inside)
        raise ModelError(
            f"the joints must be joint '{joints[0]}' and all that hangs on it, parents first: "
            f"{needed}"
        )
    return np.array(index)


def sub_parents(tree: Tree, index: np.ndarray) -> tuple[int, ...]:
    """Parents of a sub-chain's joints as a tree of its own, the carrier as its base."""
    place = {int(j): k for k, j in enumerate(index)}
    return tuple(place.get(tree.parent[int(j)], BASE) for j in index)
