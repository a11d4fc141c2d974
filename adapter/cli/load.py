"""`adapter load`: what the hand carries, as the numbers to type into the robot."""

from __future__ import annotations

import argparse

from adapter.cli.common import robot_of_log, told_of
from adapter.gap.load import as_json, find_load, robot_lines, sentence
from adapter.gap.torque_gains import as_told
from adapter.runs.compiling import announce_compiling
from adapter.runs.terminal import console, output, say, warn, write_json
from adapter.signals.importer import read_log


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    announce_compiling(say)
    log = read_log(args.log, topic=args.topic)
    empty = None if args.empty is None else read_log(args.empty, topic=args.topic)
    robot = robot_of_log(args, log)
    told = told_of(args)
    given = [log] if empty is None else [log, empty]
    (log, *others), gains = as_told(given, robot, told, given[1:])
    warn([] if gains is None else [*gains.notes, *gains.words()])
    empty = others[0] if others else None
    load = find_load(log, robot, empty, args.frame, args.inertia_prior)
    warn(list(load.notes))
    files = {"recording": str(args.log), "empty": str(args.empty) if args.empty else None}
    learned = None if gains is None else gains.as_dict()
    figures = {**as_json(load), **files, "model": robot.name, "torque_gains": learned}
    write_json(args.json, figures)
    shown = console if str(args.json) == "-" else output
    shown.print(sentence(load), soft_wrap=True)
    for robot_name, line in robot_lines(load).items():
        shown.print(f"{robot_name}: {line}", soft_wrap=True)
    if load.com_shown and not load.inertia_shown:
        shown.print("inertia: not shown; zeros stand for it above")
    return 0
