"""`adapter diff`: two models of one arm, joint by joint."""

from __future__ import annotations

import argparse
from dataclasses import replace

from rich.table import Table

from adapter.cli.common import robot_of
from adapter.report import difference_words as words
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
    if args.second is not None and len(set(found.names)) == 1:  # two runs of one arm
        found = replace(found, names=(args.first, args.second))
    write_json(args.json, words.difference_json(found))
    shown = console if str(args.json) == "-" else output
    for line in words.difference_summary(found):
        shown.print(line, soft_wrap=True)
    for heads, rows in (
        (words.MATRIX_HEADS, words.difference_matrix(found)),
        (words.EFFECT_HEADS, words.effect_rows(found)),
    ):
        if not rows:
            continue
        table = Table(*heads, box=None, pad_edge=False, title_justify="left", padding=(0, 2, 0, 0))
        for row in rows:
            table.add_row(*row)  # cells hold lines of their own
        shown.print(table)
    if found.changes:
        shown.print(words.LEGEND, soft_wrap=True)
    return 0
