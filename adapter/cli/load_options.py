"""Options of `adapter load`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import (
    add_joints,
    add_json,
    add_told,
    add_topic,
    check_logs,
    check_robot,
    check_told,
)
from adapter.errors import UsageError


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Weigh what the hand carries from the first sample of a recording on: mass, centre and "
        "inertia with standard deviations, and the lines that Franka and Universal Robots take. "
        "Without --empty the documented arm is the reference."
    )
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="recording with the load, moving or at rest")
    add_topic(parser)
    add("--empty", type=Path, metavar="LOG", help="of the same arm without it: errors cancel")
    add("--robot", metavar="NAME|FILE", help="documented robot; the log's own, else panda")
    add_joints(parser)
    add_told(parser)
    add("--frame", metavar="NAME", help="in whose axes (default: the flange of the last link)")
    add(
        "--inertia-prior",
        type=float,
        metavar="SHARE",
        help="standard deviation of the model's inertial numbers, of their size (default 0.05; "
        "0.2 with --empty)",
    )
    add_json(parser, or_output=True)
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> None:
    check_told(args)
    if args.learn_gains and args.empty is None:
        raise UsageError("--tau-gain fit needs --empty LOG: gains and load cannot be told apart")
    if args.inertia_prior is not None and not 0.0 < args.inertia_prior <= 1.0:
        raise UsageError(f"--inertia-prior must be in (0, 1], got {args.inertia_prior}")
    if args.robot is not None:
        check_robot(args.robot)
    check_logs(args.log, args.empty)
