"""Trials of `adapter discover`: shuffled recordings of the Panda and ATLAS, right or not, by seed.

Run at idle priority where something else matters on the machine. `--hard` adds short, noisy and
half-still motions, for which the tree need not be right but no wrong edge may be trusted.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from adapter.discovery import Discovery, discover
from tests.helpers.benchmark import options, write
from tests.helpers.discovery_data import TRUSTED, Case, Motion, anyhow, record
from tests.helpers.discovery_data import robot as model_of

ROBOTS = ("panda", "atlas")


@dataclass(frozen=True)
class Kind:
    """One kind of trial: how long, how noisy, what is recorded, what stands still.

    Attributes:
        resting, alike: joints that rest, pairs that move alike, drawn by the seed.
        mounted: share of the sensors that are mounted anyhow, drawn by the seed.
        named: whether a floating base is told to `discover`.
    """

    name: str
    seconds: float = 10.0
    noise: float = 1.0
    parts: str = "ta"
    resting: int = 0
    alike: int = 0
    base: bool | None = None
    mounted: float = 0.0
    named: bool = False

    def case(self, name: str, seed: int) -> Case:
        """The recording of a seed."""
        n = model_of(name).tree.n
        drawn = np.random.default_rng([seed, 23]).permutation(n).tolist()
        still = tuple(drawn[: self.resting])
        rest = drawn[self.resting :]
        pairs = tuple((rest[2 * k], rest[2 * k + 1]) for k in range(self.alike))
        motion = Motion(self.seconds, 1000.0, still, pairs)
        loose = np.random.default_rng([seed, 31]).permutation(1 + n)
        loose = loose[: round(self.mounted * len(loose))]
        mounts = anyhow(seed, loose.tolist(), 1 + n)
        return record(
            name, motion, seed, noise=self.noise, base=self.base, parts=self.parts, mounts=mounts
        )


USUAL = (
    Kind("realistic, 10 s"),
    Kind("realistic, 5 s", 5.0),
    Kind("twists only, 10 s", parts="t"),
    Kind("accelerations only, 10 s", parts="a"),
    Kind("mounted anyhow, 10 s", mounted=1.0),
    Kind("mounted anyhow, base named, 10 s", mounted=1.0, named=True),
    Kind("some mounted anyhow, 10 s", mounted=0.2),
    Kind("mounted anyhow, twists only, 10 s", parts="t", mounted=1.0),
    Kind("mounted anyhow, accelerations only, 10 s", parts="a", mounted=1.0),
)
HARD = (
    Kind("1 s", 1.0),
    Kind("noise x 20, 2 s", 2.0, 20.0),
    Kind("noise x 100, 1 s", 1.0, 100.0),
    Kind("2 joints rest, 5 s", 5.0, resting=2),
    Kind("4 joints rest, 2 s", 2.0, resting=4),
    Kind("2 joints move alike, 5 s", 5.0, alike=1),
    Kind("mounted anyhow, 1 s", 1.0, mounted=1.0),
    Kind("mounted anyhow, noise x 20, 2 s", 2.0, 20.0, mounted=1.0),
    Kind("mounted anyhow, noise x 50, 5 s", 5.0, 50.0, mounted=1.0),
    Kind("mounted anyhow, 2 joints rest, 5 s", 5.0, resting=2, mounted=1.0),
    Kind("mounted anyhow, 4 joints rest, 2 s", 2.0, resting=4, mounted=1.0),
    Kind("mounted anyhow, 2 joints alike, 5 s", 5.0, alike=1, mounted=1.0),
)


def judge(case: Case, found: Discovery) -> dict[str, Any]:
    """Right, wrong, and the confidences that matter.

    An edge whose direction is said to be open is right if it connects the right links. What
    counts against an edge is its confidence as it stands, or that of a connection that is not.
    """
    named = {
        (e.joint, e.link, e.parent): e for e in found.edges if e.joint and e.parent is not None
    }
    either_way = case.edges | {(joint, parent, link) for joint, link, parent in case.edges}
    truth = {key: either_way if not e.directed else case.edges for key, e in named.items()}
    right = [e.connected for key, e in named.items() if key in truth[key]]
    wrong = [e.connected for key, e in named.items() if key not in truth[key]]
    told = [e.confidence for key, e in named.items() if key not in case.edges]
    root = found.root == case.root or found.root_confidence <= TRUSTED
    return {
        "edges": len(case.edges),
        "right": len(right),
        "all_right": len(right) == len(case.edges) and not wrong and root,
        "directed": len(case.edges & set(named)),
        "least_right": min(right, default=None),
        "trusted_right": sum(c > TRUSTED for c in right),
        "wrong": len(wrong),
        "worst_wrong": max(wrong + told, default=0.0),
        "root_right": found.root == case.root,
        "worst_root": found.root_confidence if found.root not in (case.root, None) else 0.0,
        "undecided": len(found.undecided),
    }


def trial(robot: str, kind: Kind, seed: int) -> dict[str, Any]:
    """Record, discover, judge."""
    case = kind.case(robot, seed)
    begun = time.process_time()
    found = discover(case.log, base=case.root if kind.named and case.root in case.body else None)
    seconds = time.process_time() - begun
    facts = {"robot": robot, "kind": kind.name, "seed": seed, "seconds": seconds}
    return {**facts, **judge(case, found)}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each robot and kind."""
    out = []
    for robot, kind in dict.fromkeys((row["robot"], row["kind"]) for row in rows):
        part = [row for row in rows if (row["robot"], row["kind"]) == (robot, kind)]
        edges = sum(row["edges"] for row in part)
        out.append(
            {
                "robot": robot,
                "kind": kind,
                "trials": len(part),
                "all_right": sum(row["all_right"] for row in part),
                "edges_right": sum(row["right"] for row in part) / edges,
                "edges_trusted": sum(row["trusted_right"] for row in part) / edges,
                "least_right": min((r["least_right"] or 0.0 for r in part), default=0.0),
                "worst_wrong": max(row["worst_wrong"] for row in part),
                "root_right": sum(row["root_right"] for row in part),
                "worst_root": max(row["worst_root"] for row in part),
                "seconds": float(np.median([row["seconds"] for row in part])),
            }
        )
    return out


def _print(console: Console, table: list[dict[str, Any]]) -> None:
    shown = Table(
        "robot", "motion", "tree right", "edges right", "of all trusted",
        "least conf. of a right edge", "most of a wrong one", "root right", "most of a wrong one",
        "CPU s", box=None,
    )  # fmt: skip
    for row in table:
        shown.add_row(
            row["robot"],
            row["kind"],
            f"{row['all_right']} of {row['trials']}",
            f"{100 * row['edges_right']:.1f} %",
            f"{100 * row['edges_trusted']:.1f} %",
            f"{row['least_right']:.4f}",
            f"{row['worst_wrong']:.3f}",
            f"{row['root_right']}",
            f"{row['worst_root']:.3f}",
            f"{row['seconds']:.1f}",
        )
    console.print(shown)


def main() -> None:
    """Run the trials asked for."""
    parser = options(__doc__, trials=20, first=0)
    parser.add_argument("--hard", action="store_true", help="hard kinds as well")
    asked = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    console, rows = Console(width=150), []
    kinds = (*USUAL, *(HARD if asked.hard else ()))
    for robot in ROBOTS:
        for seed in range(asked.first, asked.first + asked.trials):  # kinds share their motions
            rows += [trial(robot, kind, seed) for kind in kinds]
            console.print(f"{robot}: seed {seed}", end="\r")
            write(asked.json, {"summary": summary(rows), "rows": rows})
    _print(console, summary(rows))


if __name__ == "__main__":
    main()
