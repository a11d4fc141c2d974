"""`adapter experiment`: the paper's experiments (section IV) again, beside what it states."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from adapter.experiments.atlas import run_atlas
from adapter.experiments.page.page import render_experiment
from adapter.experiments.panda import run_panda
from adapter.experiments.results import AtlasResults, PandaResults, Stated
from adapter.report.html import write_whole
from adapter.runs.terminal import (
    json_ready,
    output,
    program_version,
    results_folder,
    show,
    write_json,
)

PANDA_S = 40.0  # of motion; the paper's λ needs as long
PAGE = "experiment.html"


def run(args: argparse.Namespace) -> int:
    """Carry the command out; what one experiment found is written before the next begins."""
    folder = results_folder(args.out, "experiment")
    atlas: AtlasResults | None = None
    panda: PandaResults | None = None
    for name in dict.fromkeys(args.names):
        if name == "atlas":
            atlas = run_atlas(args)
            print_stated("ATLAS, section IV.A", atlas.stated)
        else:
            panda = run_panda(args.seed, PANDA_S, args.seeds)
            print_stated("Panda, section IV.B", panda.stated)
        _write(args, folder, atlas, panda)
    show(f"report {folder / PAGE}")
    return 0


def _write(
    args: argparse.Namespace, folder: Path, atlas: AtlasResults | None, panda: PandaResults | None
) -> None:
    figures = {
        name: {**results.numbers, "stated": [asdict(row) for row in results.stated]}
        for name, results in (("atlas", atlas), ("panda", panda))
        if results is not None
    }
    written = f"panda-adapter {program_version()}, seed {args.seed}"
    write_whole(folder / PAGE, render_experiment(atlas, panda, written))
    write_json(folder / "experiment.json", figures)
    write_json(args.json, figures)


def print_stated(title: str, stated: list[Stated]) -> None:
    """The paper's figures and ours."""
    table = Table("", "paper", "ours", title=title, title_justify="left", box=None, pad_edge=False)
    for row in stated:
        unit = "" if row.ours is None else row.unit
        table.add_row(row.what, row.paper or "-", f"{shown(row.ours)} {unit}".strip())
    output.print(table)


def shown(value: Any) -> str:
    """A figure in few digits."""
    value = json_ready(value)
    if value is None:
        return "not run"
    if isinstance(value, float):
        return f"{value:.3g}" if np.isfinite(value) else str(value)
    return str(value)
