"""Options of `adapter excite`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import (
    add_joints,
    add_json,
    add_motion,
    check_files,
    check_logs,
    check_robot,
    numbers,
)
from adapter.control.settings import DESIGNED
from adapter.errors import UsageError

SHARE, LONGEST_S, RATE_HZ = 0.2, 300.0, 200.0


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Design a motion inside all limits, clear of the cell and of the arm itself, that brings "
        "every parameter which torques show to a wanted standard deviation in the shortest time, "
        "going on from what LOGs tell already; or, with --gap, the motion that a gap report asks "
        "to be measured next. Writes it as CSV, as MCAP (trajectory_msgs/JointTrajectory) and as a "
        "page; nothing moves. `adapter run --excitation designed` moves an arm so."
    )
    add = parser.add_argument
    add("logs", nargs="*", type=Path, metavar="LOG", help="recordings of the arm that are there")
    add("--robot", metavar="NAME|FILE", help="panda (default), fr3, .urdf, .xml (MJCF) or .json")
    add_joints(parser)
    add("--config", type=Path, metavar="FILE", help="settings in TOML: [cell], [excitation], ...")
    add(
        "--at", metavar="Q1,Q2,...", help="where it starts, rad (default: where the first LOG does)"
    )
    add(
        "--std",
        type=float,
        default=SHARE,
        metavar="SHARE",
        help="wanted, of the parameters of a body of 1 kg, 10 cm across, and of an effect's usual "
        f"size (default {SHARE:g}: 0.2 kg, 0.02 kg m, 0.002 kg m², 0.2 N m of friction)",
    )
    add(
        "--noise",
        metavar="S1,S2,...",
        help="standard deviation of each joint's torque, N m (default: of the LOGs, else 0.3 %% of "
        "the effort limits)",
    )
    add("--gap", type=Path, metavar="FILE", help="JSON of `adapter gap`: what to measure next")
    add_motion(parser)
    add("--seed", type=int, help="of the motion")
    add("--longest", type=float, default=LONGEST_S, metavar="S", help=f"default {LONGEST_S:g}")
    add(
        "--rate", type=float, default=RATE_HZ, metavar="HZ", help=f"of points (default {RATE_HZ:g})"
    )
    add_json(parser)
    add("--out", type=Path, metavar="FOLDER", help="where results go")
    parser.set_defaults(check=_check, excitation=DESIGNED)


def _check(args: argparse.Namespace) -> None:
    if args.robot is not None:
        check_robot(args.robot)
    check_files(args.config, args.gap)
    args.logs = check_logs(*args.logs)
    args.at = numbers("--at", args.at, what="numbers")
    args.noise = numbers("--noise", args.noise)
    for name, least in (("std", 0.0), ("longest", 1.0), ("rate", 1.0)):
        if not getattr(args, name) > least:
            raise UsageError(f"--{name} must be above {least:g}, got {getattr(args, name)}")
