"""Beyond the paper: whether discovery finds the tree of recordings whose order and names are lost.

Every recording is shuffled and renamed first, so that nothing but the signals can tell.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adapter.discovery import Discovery, discover
from adapter.discovery.verdict import UNSEEN_BASE
from adapter.tree import BASE, Tree
from drivers.mcap_file import Log

Edges = frozenset[tuple[str, str, str]]  # (joint, the link it moves, its parent)


@dataclass(frozen=True)
class Puzzle:
    """A shuffled recording, and the tree that discovery is to find in it."""

    log: Log
    edges: Edges
    root: str


def shuffled(log: Log, tree: Tree, rng: np.random.Generator) -> Puzzle:
    """Joints and links in random order, under names that tell nothing.

    Args:
        log: its joints and links are named as the tree's; the base may be among its links.
        tree: the truth.
        rng: draws the order.
    """
    joints = [str(name) for name in rng.permutation(log.joint_names)]
    links = [str(name) for name in rng.permutation(log.link_names)]
    joint = {name: f"joint {k}" for k, name in enumerate(joints)}
    link = {name: f"link {k}" for k, name in enumerate(links)}
    root = link.get(tree.base_name, UNSEEN_BASE)
    parents = [root if i == BASE else link[tree.link_names[i]] for i in tree.parent]
    edges = frozenset(
        (joint[name], link[moved], parent)
        for name, moved, parent in zip(tree.joint_names, tree.link_names, parents, strict=True)
    )
    mixed = replace(
        log.select(joints, links),
        joint_names=tuple(joint.values()),
        link_names=tuple(link.values()),
        metadata={},
    )
    return Puzzle(mixed, edges, root)


def judged(puzzle: Puzzle, found: Discovery) -> dict[str, Any]:
    """What discovery made of a puzzle: right or not, and the confidences that matter."""
    named = {(e.joint, e.link, e.parent): e.confidence for e in found.edges if e.joint}
    right = [c for edge, c in named.items() if edge in puzzle.edges]
    wrong = [c for edge, c in named.items() if edge not in puzzle.edges]
    return {
        "right": len(right) == len(puzzle.edges) and not wrong and found.root == puzzle.root,
        "least_confidence_right": min(right, default=0.0),
        "most_confidence_wrong": max(wrong, default=0.0),
        "motion_s": found.recorded.duration_s,
    }


def topology_trials(logs: Iterable[Log], tree: Tree, seed: int) -> dict[str, Any]:
    """Shuffle, discover and judge recordings of one tree.

    Returns:
        trials, right (trees wholly right), least_confidence_right and most_confidence_wrong (of
        an edge, over all trials), motion_s (the longest recording), channels that were measured.
    """
    rows, measured = [], ""
    for k, log in enumerate(logs):
        puzzle = shuffled(log, tree, np.random.default_rng([seed, k]))
        found = discover(puzzle.log)
        measured = ", ".join(found.recorded.measured)
        rows.append(judged(puzzle, found))
    return {
        "trials": len(rows),
        "right": sum(row["right"] for row in rows),
        "least_confidence_right": min((r["least_confidence_right"] for r in rows), default=0.0),
        "most_confidence_wrong": max((r["most_confidence_wrong"] for r in rows), default=0.0),
        "motion_s": max((row["motion_s"] for row in rows), default=0.0),
        "measured": measured,
    }
