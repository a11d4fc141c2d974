"""`adapter diff`: two models of one arm, joint by joint."""

from __future__ import annotations

import argparse

from rich.table import Table

from adapter.cli.common import robot_of
from adapter.report.difference_words import (
    HEADS,
    LEGEND,
    difference_json,
    difference_rows,
    difference_summary,
)
from adapter.runs.compare import compare, documentation_of
from adapter.runs.terminal import console, output, write_json


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out: from the documentation to the model, or from A to B."""
    first = robot_of(args, args.first)
    if args.second is None:
        first, second = documentation_of(first), first
    else:
        second = robot_of(args, args.second)
    found = compare(first, second)
    write_json(args.json, difference_json(found))
    shown = console if str(args.json) == "-" else output
    rows = difference_rows(found)
    if rows:
        table = Table(*HEADS, box=None, pad_edge=False, caption=LEGEND, caption_justify="left")
        for row in rows:
            table.add_row(*row)
        shown.print(table)
    for line in difference_summary(found):
        shown.print(line, soft_wrap=True)
    return 0
