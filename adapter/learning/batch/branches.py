"""The sub-problems that the topology dictates: the branches that hang on the base (paper, Fig. 3).

With the base's motion measured, the joint torques of a branch depend on its own links alone.
Names are for the reader; nothing depends on them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from adapter.model.tree import BASE, Tree

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
