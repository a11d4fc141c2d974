"""Options of `adapter gap`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import (
    add_joints,
    add_results,
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
        "Find where a model and recordings disagree, name the effects that the model lacks, add "
        "them, and measure the gap again on data that the fit never saw. Several "
        "recordings are of one arm: friction, inertias and offsets are common, what the hand "
        "carries and what pushes it is each one's own. A recording in which too little moves to "
        "tell anything is an answer too; one that does not fit the model (another robot, flipped "
        "signs, other units) cannot be used."
    )
    add = parser.add_argument
    add("logs", nargs="+", type=Path, metavar="LOG", help="recording, or a folder of such")
    add_topic(parser)
    add(
        "--model",
        required=True,
        metavar="MODEL",
        help="self model (.json), .urdf, .xml (MJCF), or a robot known by name: panda",
    )
    add_joints(parser)
    add(
        "--servo",
        type=Path,
        metavar="FILE",
        help="recordings of a position-controlled arm (commanded and measured positions, no "
        "torque): its servos as documented, TOML as the results' servo.toml (default: nobody "
        "documented them, commands should be where the arm is)",
    )
    add_told(parser)
    add(
        "--inertia-prior",
        type=float,
        metavar="SHARE",
        help="standard deviation of the model's inertial numbers, of their size (default 0.02; "
        "it may turn out to be up to 8 times that)",
    )
    add(
        "--hold-out",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        metavar="LOG",
        help="score on these, fit all others (default: blocks of time are held out in turn)",
    )
    add("--validate-from", type=float, metavar="S", help="fit before this second, score after it")
    add(
        "--rounds",
        type=int,
        metavar="N",
        help="rounds of the search, in each of which something may be named (default 24)",
    )
    add(
        "--simulator",
        choices=("pybullet", "mujoco"),
        help="of the forward simulation (default pybullet where it is installed, extra [sim]; "
        "mujoco is the extra [mujoco])",
    )
    add("--no-simulation", action="store_true", help="compare torques only")
    add_results(parser)
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> None:
    args.logs, args.hold_out = check_logs(*args.logs), check_logs(*args.hold_out)
    if args.validate_from is not None and (args.hold_out or len(args.logs) > 1):
        raise UsageError("--validate-from splits one LOG; of several, --hold-out names the scored")
    check_told(args)
    check_robot(args.model)
