"""Beyond the paper: whether discovery finds the tree of recordings whose order and names are lost.

Every recording is shuffled and renamed first, so that nothing but the signals can tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.discovery import UNSEEN_BASE, Discovery, discover
from adapter.experiments.results import Stated
from adapter.learning.learner import OnlineLearner
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.model.tree import BASE, Tree
from adapter.realtime.session import run_lockstep
from adapter.runs.config import PipelineSettings
from adapter.runs.pipeline import make_front_end
from adapter.signals.front_end import FrontEnd
from drivers.files.mcap import Log
from drivers.interface import JointSample
from sim.falls.data_set import FallData
from sim.falls.fall import RATE_HZ
from sim.plant import SimulatedArm
from sim.scenarios import Scenario, build

MOTION_S = 10.0  # of each recording, from its start (the project's goal: at most that)
Edges = frozenset[tuple[str, str, str]]  # (joint, the link it moves, its parent)


@dataclass(frozen=True)
class Shuffled:
    """A shuffled recording, and the tree that discovery is to find in it."""

    log: Log
    edges: Edges
    root: str


def shuffled(log: Log, tree: Tree, rng: np.random.Generator) -> Shuffled:
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
    mixed, joint_names = log.select(joints, links), tuple(joint.values())
    told = replace(mixed, joint_names=joint_names, link_names=tuple(link.values()), metadata={})
    return Shuffled(told, edges, root)


def judged(asked: Shuffled, found: Discovery) -> dict[str, Any]:
    """What discovery made of it: right or not, and the confidences that matter."""
    named = {(e.joint, e.link, e.parent): e.confidence for e in found.edges if e.joint}
    right = [c for edge, c in named.items() if edge in asked.edges]
    wrong = [c for edge, c in named.items() if edge not in asked.edges]
    return {
        "right": len(right) == len(asked.edges) and not wrong and found.root == asked.root,
        "least_confidence_right": min(right, default=0.0),
        "most_confidence_wrong": max(wrong, default=0.0),
        "motion_s": found.log.duration_s,
    }


def topology_trials(logs: Iterable[Log], tree: Tree, seed: int) -> dict[str, Any]:
    """Shuffle, discover and judge recordings of one tree.

    Returns:
        trials, right (trees wholly right), least_confidence_right and most_confidence_wrong (of
        an edge, over all trials), motion_s (the longest recording), channels that were measured.
    """
    rows, measured = [], ""
    for k, log in enumerate(logs):
        asked = shuffled(log, tree, np.random.default_rng([seed, k]))
        found = discover(asked.log)
        measured = ", ".join(found.log.measured)
        rows.append(judged(asked, found))
    return {
        "trials": len(rows),
        "right": sum(row["right"] for row in rows),
        "least_confidence_right": min((r["least_confidence_right"] for r in rows), default=0.0),
        "most_confidence_wrong": max((r["most_confidence_wrong"] for r in rows), default=0.0),
        "motion_s": max((row["motion_s"] for row in rows), default=0.0),
        "measured": measured,
    }


def found_trees(trials: dict[str, Any]) -> Stated:
    """Of how many recordings discovery found the whole tree, beside the paper."""
    return Stated(
        "discover",
        "N and A unknown: trees found",
        "future work",
        f"{trials['right']} of {trials['trials']}" if trials["trials"] else None,
        "",
        f"from at most {trials['motion_s']:.1f} s; links and joints shuffled and renamed",
    )


def fall_logs(noisy: FallData, count: int) -> Iterator[Log]:
    """What joints, gyroscopes and accelerometers of falling robots say, one log per fall.

    Neither velocities nor angular accelerations are in them: no such sensor is.
    """
    truth = noisy.truth
    for k in range(min(count, len(noisy))):
        measured = noisy[k]
        q = measured["q"]
        w, a = (
            np.concatenate([measured[f"base_{x}"][:, None], measured[f"link_{x}"]], axis=1)
            for x in "wa"
        )
        nothing = np.full_like(w, np.nan)
        twists, accels = np.concatenate([nothing, w], axis=2), np.concatenate([a, nothing], axis=2)
        joints = np.arange(len(q)) * round(1e9 / RATE_HZ), q, measured["dq"], measured["tau"]
        names, links = tuple(truth.joint_names), (truth.base_name, *truth.link_names)
        yield _first(Log(Path(f"fall {k}"), names, *joints, links, twists, accels))


def panda_moves(
    world: Scenario,
    robot: SelfModel,
    duration_s: float,
    settings: PipelineSettings,
    learner: OnlineLearner | None = None,
) -> tuple[SimulatedArm, list[JointSample], FrontEnd]:
    """A simulated arm moves by itself, drawn by its seed; what it said, and what heard it."""
    samples: list[JointSample] = []
    arm, front_end = SimulatedArm(world.plant()), make_front_end(robot, settings)
    excitation = ExcitationSettings(seed=world.seed)
    controller = ExcitationController(MotionLimits.of(robot), excitation)

    def keep(sample: JointSample, command: object) -> None:
        samples.append(sample)

    try:
        run_lockstep(arm, front_end, learner, controller, duration_s, each=keep)
    finally:
        arm.close()
    return arm, samples, front_end


def panda_logs(count: int, seed: int) -> Iterator[Log]:
    """What simulated Pandas with bent links say, each moving by itself; one log per seed."""
    robot = documented("panda")
    for k in range(seed, seed + count):
        world = build("bent_link", k)
        arm, samples, _ = panda_moves(world, robot, MOTION_S, PipelineSettings())
        keys, path = ("stamp_ns", "q", "dq", "tau"), Path("simulated Panda")
        stamps, q, dq, tau = (np.array([getattr(x, key) for x in samples]) for key in keys)
        links = [sample.links for sample in samples if sample.links is not None]
        twists, accels = (np.array([getattr(x, key) for x in links]) for key in ("twist", "accel"))
        names, links_of = arm.joint_names, arm.link_names
        yield _first(Log(path, names, stamps, q, dq, tau, links_of, twists, accels))


def _first(log: Log) -> Log:
    """The first seconds of a recording."""
    return log.piece(0, int(np.searchsorted(log.stamp_ns, log.first_ns + round(1e9 * MOTION_S))))
