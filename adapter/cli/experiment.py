"""`adapter experiment`: the paper's experiments (section IV) again, beside what it states."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from adapter.cli.common import (
    UsageError,
    check_writable,
    console,
    plain,
    program_version,
    write_json,
)
from adapter.cli.results import results_folder
from adapter.experiment.results import AtlasResults, PandaResults, Stated
from adapter.experiment.trajectories import LEAST_TRAJECTORIES, learned_samples
from adapter.report.experiment_page import write_experiment

EXPERIMENTS = ("atlas", "panda")
PANDA_S = 40.0  # of motion; the paper's λ needs as long
PAGE = "experiment.html"
LEAST_LEARNED = 50  # samples; far fewer show λ and θ of 30 joints only by chance


def add_parser(commands: Any) -> None:
    """Declare the subcommand."""
    parser = commands.add_parser(
        "experiment",
        help="rerun the paper's experiments",
        description="Rerun section IV of the paper: `atlas`, a simulated humanoid in free fall "
        "against three learners that know no physics, and `panda`, online learning at 1 kHz. "
        "Prints the paper's figures beside ours and makes one HTML page.",
    )
    parser.add_argument(
        "names", nargs="+", choices=EXPERIMENTS, metavar="NAME", help="which: atlas, panda"
    )
    parser.add_argument("--full", action="store_true", help="the baselines in the paper's size")
    parser.add_argument("--no-baselines", action="store_true", help="atlas: only the FOP networks")
    parser.add_argument(
        "--trajectories", type=int, default=63, metavar="N", help="atlas: default 63"
    )
    parser.add_argument(
        "--seconds", type=float, default=10.0, metavar="S", help="atlas: of each; default 10"
    )
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N",
        help="recordings whose tree is to be found, N and A unknown; default 20",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="of every random choice")
    parser.add_argument(
        "--cache", type=Path, metavar="FOLDER", help="where simulated data are kept"
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where results go")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out; what one experiment found is written before the next begins."""
    _check(args)
    folder = results_folder(args, "experiment")
    atlas: AtlasResults | None = None
    panda: PandaResults | None = None
    for name in dict.fromkeys(args.names):
        if name == "atlas":
            from adapter.cli.experiment_atlas import run_atlas

            atlas = run_atlas(args)
            print_stated("ATLAS, section IV.A", atlas.stated)
        else:
            from adapter.cli.experiment_panda import run_panda

            panda = run_panda(args.seed, PANDA_S, args.seeds)
            print_stated("Panda, section IV.B", panda.stated)
        _write(args, folder, atlas, panda)
    console.print(f"report {folder / PAGE}", soft_wrap=True)
    return 0


def _check(args: argparse.Namespace) -> None:
    """Before minutes of work. Raises UsageError or OSError for what would end it."""
    if args.seed < 0 or args.seeds < 0:
        raise UsageError("--seed and --seeds must be 0 or more")
    check_writable(args.json)
    if "atlas" not in args.names:
        return
    if args.trajectories < LEAST_TRAJECTORIES:
        raise UsageError(f"--trajectories must be at least {LEAST_TRAJECTORIES}")
    if not 0.0 < args.seconds < np.inf:
        raise UsageError(f"--seconds must be above 0 and finite, got {args.seconds}")
    learned = learned_samples(args.trajectories, round(1000.0 * args.seconds))
    if learned < LEAST_LEARNED:
        raise UsageError(
            f"{args.trajectories} falls of {args.seconds:g} s give {learned} samples to learn "
            f"from (1 % of the training set), fewer than {LEAST_LEARNED}; raise --trajectories "
            "or --seconds"
        )


def _write(
    args: argparse.Namespace, folder: Path, atlas: AtlasResults | None, panda: PandaResults | None
) -> None:
    figures = {
        name: {**results.numbers, "stated": [asdict(row) for row in results.stated]}
        for name, results in (("atlas", atlas), ("panda", panda))
        if results is not None
    }
    written = f"panda-adapter {program_version()}, seed {args.seed}"
    write_experiment(folder / PAGE, atlas, panda, written)
    write_json(folder / "experiment.json", figures)
    write_json(args.json, figures)


def print_stated(title: str, stated: list[Stated]) -> None:
    """The paper's figures and ours."""
    table = Table("", "paper", "ours", title=title, title_justify="left", box=None, pad_edge=False)
    for row in stated:
        unit = "" if row.ours is None else row.unit
        table.add_row(row.what, row.paper or "-", f"{shown(row.ours)} {unit}".strip())
    console.print(table)


def shown(value: Any) -> str:
    """A figure in few digits."""
    value = plain(value)
    if value is None:
        return "not run"
    if isinstance(value, float):
        return f"{value:.3g}" if np.isfinite(value) else str(value)
    return str(value)
