"""`adapter bench`: our update beside what one would pick instead, in one run."""

from __future__ import annotations

import argparse
from typing import Any

from rich.table import Table

from adapter.cli.common import add_json_option, console, write_json


def add_parser(commands: Any) -> None:
    """Declare the subcommand."""
    parser = commands.add_parser(
        "bench",
        help="time the update beside its rivals",
        description="Times one update of λ and θ of a Panda beside autograd through the torch "
        "networks, Pinocchio's regressor with recursive least squares (if pin is installed) and "
        "differentiable-robot-model (extra [peers], if installed).",
    )
    parser.add_argument("--repeats", type=int, default=2000, metavar="N", help="default 2000")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    from adapter.benchmark import benchmark  # brings torch

    rows = benchmark(max(args.repeats, 10))
    table = Table("what", "p50 µs", "p99 µs", "note", box=None, pad_edge=False)
    for row in rows:
        p50, p99 = row["p50_us"], row["p99_us"]
        shown = ("-", "-") if p50 is None else (f"{p50:.1f}", f"{p99:.1f}")
        table.add_row(row["what"], *shown, row["note"])
    console.print(table)
    write_json(args.json, {"rows": rows})
    return 0
