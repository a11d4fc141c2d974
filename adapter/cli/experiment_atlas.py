"""The paper's humanoid (section IV.A): simulated data, learned, judged and compared."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from adapter.cli.common import console
from adapter.cli.experiment_topology import fall_logs
from adapter.experiment.atlas import judge, learn_body, noisy_trial
from adapter.experiment.atlas_figures import numbers_of, stated
from adapter.experiment.comparison import arm_tables, choices, compare
from adapter.experiment.online import noisy, online_trial, without_velocity
from adapter.experiment.results import AtlasResults
from adapter.experiment.topology import topology_trials
from adapter.experiment.trajectories import gathered, split
from adapter.offline.signals import Measured, smoothed_data
from adapter.tree import Tree
from adapter.tree_data import BodyMotion, TreeData
from sim.free_fall_data import FallData, data_set
from sim.tree_links import link_tables

ONLINE_FALLS = 3  # that the online learner sees, 30 s in all
ARM = tuple(range(23, 30))  # the right arm: joints 24 to 30 of the paper's Fig. 5e


class Fall:
    """Simulated trajectories as samples for learners."""

    def __init__(self, exact: FallData, noisy: FallData) -> None:
        self._exact, self.noisy = exact, noisy
        self.truth = truth = exact.truth
        self.tree = Tree(truth.parent, True, truth.joint_names, truth.link_names, truth.base_name)

    def __len__(self) -> int:
        return len(self._exact)

    def exact(self, k: int) -> TreeData:
        """Trajectory k without noise."""
        record = self._exact.exact(k)
        base = (record.base_v, record.base_w, record.base_a, record.base_dw)
        links = link_tables(self.truth, record.q, record.dq, record.ddq, base)
        free = np.zeros((len(record.q), 6))  # nothing pushes a falling base
        return TreeData(
            self.tree,
            record.q,
            record.dq,
            record.ddq,
            np.hstack([free, record.tau]),
            BodyMotion(record.base_w, record.base_a, record.base_dw, record.base_v),
            BodyMotion(links.w, links.a, links.dw, links.v),
        )

    def measured(self, k: int) -> TreeData:
        """Trajectory k as its sensors show it, filtered alike."""
        return smoothed_data(self.tree, Measured(**self.noisy[k]))


def run_atlas(args: argparse.Namespace) -> AtlasResults:
    """The whole experiment; says what it is at."""

    def say(line: str) -> None:
        console.print(f"[dim]{line}[/]", soft_wrap=True)

    began = time.perf_counter()
    say(f"simulating {args.trajectories} falls of {args.seconds:g} s, where none are kept")
    options: dict[str, Any] = {
        "trajectories": args.trajectories, "seconds": args.seconds, "seed": args.seed,
        "folder": args.cache,
    }  # fmt: skip
    source = Fall(data_set("atlas", **options), data_set("atlas", noise=True, **options))
    truth, tree = source.truth, source.tree
    count = len(source)  # trajectories, all of one length
    parts = split(count * [len(source.exact(0))], args.seed)
    data = gathered(source, parts, parts.learned, noisy=False)
    simulated_s = time.perf_counter() - began
    say(f"learning λ and θ from {len(data)} samples")
    body = learn_body(data, args.seed)
    say("judging all samples")
    judged = judge(body, data, source, parts, ARM)
    say("learning from noisy sensors")
    noisy_parts = split(count * [len(source.measured(0))], args.seed)
    noise = noisy_trial(source, noisy_parts, truth.lam, args.seed)
    learners = [judged.learned]
    if not args.no_baselines:
        joints = [tree.joint_names[j] for j in ARM]
        carrier = tree.link_names[tree.parent[ARM[0]]]
        tables = arm_tables(source, parts, joints, carrier)
        chosen = choices(tree, truth.lam, joints, carrier, args.full, args.seed)
        learners += compare(tables, chosen, args.seed, say)
    say("learning online, sample by sample")
    online = online_numbers(source, parts.control)
    say(f"finding the tree of {min(args.seeds, count)} falls, shuffled and renamed")
    found = topology_trials(fall_logs(source.noisy, args.seeds), tree, args.seed)
    numbers = {
        **numbers_of(body, judged, noise, learners, parts, data, tree),
        "online": online,
        "discover": found,
        "trajectory_s": args.seconds,
        "simulated_s": simulated_s,
        "wall_s": time.perf_counter() - began,
    }
    return AtlasResults(
        tree=tree,
        true_lam=truth.lam,
        arm=ARM,
        snapshots=snapshots(body.networks.snapshots),
        cost=body.networks.loss,
        error_edges=np.log10(judged.training.edges),
        error_counts=judged.networks_training.histogram,
        moments_error_counts=judged.training.histogram,
        not_converged=tuple(numbers["schema_networks_not_converged"]),
        full=args.full,
        learners=learners,
        stated=stated(numbers),
        numbers=numbers,
    )


def online_numbers(source: Fall, control: Sequence[int]) -> dict[str, Any]:
    """The online learner on falls with noise, judged on one that it never sees."""
    used = [k for k in range(len(source)) if k not in control][:ONLINE_FALLS]
    motions = [noisy(without_velocity(source.exact(k)), k) for k in used]
    return online_trial(motions, source.exact(control[0]), source.truth.lam)[0]


def snapshots(kept: dict[int, np.ndarray]) -> list[tuple[str, np.ndarray]]:
    """λ by label, the last one called final."""
    last = max(kept)
    return [("final" if epoch == last else f"epoch {epoch}", kept[epoch]) for epoch in sorted(kept)]
