"""`adapter load`: what the hand carries, as the numbers to type into the robot."""

from __future__ import annotations

import argparse

from rich.markup import escape

from adapter.cli.common import robot_of_log
from adapter.gap.load import find_load
from adapter.gap.load_words import as_json, robot_lines, sentence
from adapter.runs.compiling import announce_compiling
from adapter.runs.terminal import console, json_text, warn, write_json
from drivers.files.mcap import read_log


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    announce_compiling(console.print)
    log = read_log(args.log)
    empty = None if args.empty is None else read_log(args.empty)
    robot = robot_of_log(args, log)
    load = find_load(log, robot, empty, args.frame, args.inertia_prior)
    warn(list(load.notes))
    files = {"recording": str(args.log), "empty": str(args.empty) if args.empty else None}
    figures = {**as_json(load), **files, "model": robot.name}
    if str(args.json) == "-":
        print(json_text(figures))
    else:
        write_json(args.json, figures)
    console.print(escape(sentence(load)), soft_wrap=True)
    for robot_name, line in robot_lines(load).items():
        console.print(f"{robot_name}: {escape(line)}", soft_wrap=True)
    if load.com_shown and not load.inertia_shown:
        console.print("inertia: not shown; zeros stand for it above")
    return 0
