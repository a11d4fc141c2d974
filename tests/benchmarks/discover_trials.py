"""Trials of `adapter discover`: shuffled recordings of the Panda and ATLAS, right or not, by seed.

Run at idle priority where something else matters on the machine. `--hard` adds short, noisy and
half-still motions, for which the tree need not be right but no wrong edge may be trusted.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from adapter.discovery import Discovery, discover
from adapter.model import SelfModel
from tests.discovery_data import Case, Motion, atlas, panda, record

TRUSTED = 0.9  # no wrong edge may have more confidence than that
ROBOTS: dict[str, Callable[[], SelfModel]] = {"panda": panda, "atlas": atlas}


@dataclass(frozen=True)
class Kind:
    """One kind of trial: how long, how noisy, what is recorded, what stands still.

    Attributes:
        resting, alike: joints that rest, pairs that move alike, drawn by the seed.
    """

    name: str
    seconds: float = 10.0
    noise: float = 1.0
    parts: str = "ta"
    resting: int = 0
    alike: int = 0
    base: bool | None = None

    def case(self, model: SelfModel, seed: int, rate_hz: float) -> Case:
        """The recording of a seed."""
        drawn = np.random.default_rng([seed, 23]).permutation(model.tree.n).tolist()
        still = tuple(drawn[: self.resting])
        rest = drawn[self.resting :]
        pairs = tuple((rest[2 * k], rest[2 * k + 1]) for k in range(self.alike))
        motion = Motion(self.seconds, rate_hz, still, pairs)
        return record(model, motion, seed, noise=self.noise, base=self.base, parts=self.parts)


USUAL = (Kind("realistic, 10 s"), Kind("realistic, 5 s", 5.0), Kind("twists only, 10 s", parts="t"))
HARD = (
    Kind("1 s", 1.0),
    Kind("noise x 20, 2 s", 2.0, 20.0),
    Kind("noise x 100, 1 s", 1.0, 100.0),
    Kind("2 joints rest, 5 s", 5.0, resting=2),
    Kind("half the joints rest, 2 s", 2.0, resting=4),
    Kind("2 joints move alike, 5 s", 5.0, alike=1),
)


def judge(case: Case, found: Discovery) -> dict[str, Any]:
    """Right, wrong, and the confidences that matter."""
    named = {(e.joint, e.link, e.parent): e.confidence for e in found.edges if e.joint}
    right = [c for edge, c in named.items() if edge in case.edges]
    wrong = [c for edge, c in named.items() if edge not in case.edges]
    return {
        "edges": len(case.edges),
        "right": len(right),
        "all_right": len(right) == len(case.edges) and not wrong and found.root == case.root,
        "least_right": min(right, default=None),
        "trusted_right": sum(c > TRUSTED for c in right),
        "wrong": len(wrong),
        "worst_wrong": max(wrong, default=0.0),
        "undecided": len(found.undecided),
    }


def trial(robot: str, kind: Kind, seed: int, rate_hz: float) -> dict[str, Any]:
    """Record, discover, judge."""
    case = kind.case(ROBOTS[robot](), seed, rate_hz)
    begun = time.perf_counter()
    found = discover(case.log)
    seconds = time.perf_counter() - begun
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
                "seconds": float(np.median([row["seconds"] for row in part])),
            }
        )
    return out


def _print(console: Console, table: list[dict[str, Any]]) -> None:
    shown = Table(
        "robot", "motion", "tree right", "edges right", "of all trusted",
        "least conf. of a right edge", "most of a wrong one", "s", box=None,
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
            f"{row['seconds']:.1f}",
        )
    console.print(shown)


def main() -> None:
    """Run the trials asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--robot", choices=sorted(ROBOTS), action="append")
    parser.add_argument("--rate", type=float, default=1000.0, help="samples a second")
    parser.add_argument("--hard", action="store_true", help="hard kinds as well")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    console, rows = Console(width=120), []
    for robot in asked.robot or ("panda", "atlas"):
        for kind in (*USUAL, *(HARD if asked.hard else ())):
            for seed in range(asked.first, asked.first + asked.trials):
                rows.append(trial(robot, kind, seed, asked.rate))
            _print(console, summary(rows)[-1:])
    table = summary(rows)
    _print(console, table)
    if asked.json:
        asked.json.write_text(json.dumps({"summary": table, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
