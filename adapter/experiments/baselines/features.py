"""One sub-chain of a tree as a table of inputs and outputs for learners that know no robot.

The torques of an arm are a function of its own q, dq, ddq and of the motion of the link that
carries it: its twist and its acceleration with gravity. So the task is well-posed, whatever the
rest of the robot does. They do not depend on the linear velocity v of that link (Galilei): v is
in the paper's list of inputs (twist) and may be taken, but it only adds three columns of
nuisance; in free fall it says how long the fall has lasted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from adapter.errors import ModelError
from adapter.experiments.baselines.learner import checked
from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import Array
from adapter.model.tree import BASE, Tree
from adapter.physics.networks import DTYPE, link_motion

# Samples whose link motion is computed at once: all links of 30 joints stay below 50 MB.
CHUNK = 20_000


@dataclass(frozen=True)
class Columns:
    """Which column of X is what: q, dq, ddq (n each), then w, a, dw and, if taken, v (3 each).

    Attributes:
        n: number of joints of the sub-chain.
        velocity: whether v of the carrying link comes last.
    """

    n: int
    velocity: bool = False

    @property
    def width(self) -> int:
        """Number of columns of X."""
        return 3 * self.n + 9 + 3 * int(self.velocity)

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
        return BodyMotion(w, a, dw, x[:, 3 * self.n + 9 :] if self.velocity else None)


def arm_problem(
    data: TreeData,
    joints: Sequence[str],
    carrier: str,
    lam: Array | None = None,
    velocity: bool = False,
) -> tuple[Array, Array]:
    """Inputs X (m, width, see `Columns`) and torques Y (m, joints) of a sub-chain.

    Args:
        data: samples of the whole tree.
        joints: names of the sub-chain's joints, from the carrier outwards; with everything that
            hangs on them, or the torques would depend on what X does not hold.
        carrier: name of the link (or base) that carries them; its motion is in its own frame.
        lam: (N, 6) known λ of the whole tree, from which the carrier's motion is computed where
            the samples don't hold link motion.
        velocity: whether v of the carrier is an input too.

    Raises:
        ModelError: joints that are no such sub-chain of that carrier, motion that is neither
            measured nor given by λ, or samples that are not finite.
    """
    index = sub_chain(data.tree, joints, carrier)
    motion = _motion_of(data, data.tree.parent[index[0]], lam)
    parts = [data.q[:, index], data.dq[:, index], data.ddq[:, index]]
    parts += [motion.w, motion.a, motion.dw]
    if velocity:
        if motion.v is None:
            raise ModelError(f"no velocity of '{carrier}' in the samples; ask for velocity=False")
        parts.append(motion.v)
    first = data.tree.rows - data.tree.n
    x, y = np.concatenate(parts, axis=1), data.tau[:, first + index]
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


def _motion_of(data: TreeData, link: int, lam: Array | None) -> BodyMotion:
    """Motion (m, 3) of a link: measured where it was, else by known λ."""
    if link == BASE:
        return data.base
    if data.links is not None:
        parts = (data.links.w, data.links.a, data.links.dw, data.links.v)
        w, a, dw, v = (None if x is None else x[:, link] for x in parts)
        assert w is not None and a is not None and dw is not None
        return BodyMotion(w, a, dw, v)
    if lam is None:
        raise ModelError(
            "the motion of the link that carries the arm was not measured; give lam (N, 6)"
        )
    starts = range(0, len(data), CHUNK)
    chunks = [_computed(data.take(slice(k, k + CHUNK)), link, lam) for k in starts]
    w, a, dw, v = (np.concatenate(part) for part in zip(*chunks, strict=True))
    return BodyMotion(w, a, dw, v if data.base.v is not None else None)


def _computed(data: TreeData, link: int, lam: Array) -> tuple[Array, Array, Array, Array]:
    """w, a, dw, v (m, 3) of a link from the base's motion; only the joints on its path count."""
    path = list(data.tree.path_to(link))
    q, dq, ddq = (signal[:, path] for signal in data.joint_signals())
    chain = Tree(tuple(range(-1, len(path) - 1)))
    lam_t = torch.as_tensor(np.asarray(lam)[path], dtype=DTYPE)
    k = link_motion(chain, lam_t, (q, dq, ddq), data.base.torch())
    w, a, dw, v = (x[:, -1].numpy() for x in (k.w, k.a, k.dw, k.v))
    return w, a, dw, v
