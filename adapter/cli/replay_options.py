"""Options of `adapter replay`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import (
    add_learning,
    add_told,
    add_topic,
    check_learning,
    check_logs,
    check_told,
)
from adapter.errors import UsageError


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Learn λ and θ from an MCAP recording, sample by sample as the live process does (the "
        "result is the same), or in batches."
    )
    add = parser.add_argument
    add(
        "logs",
        nargs="+",
        type=Path,
        metavar="LOG",
        help="recording (MCAP, rosbag2, ROS 1), or a folder of such; several of one arm are "
        "learned from in order",
    )
    add_topic(parser)
    add_learning(parser)
    add_told(parser)
    add("--every", type=int, default=1, metavar="N", help="one update per N samples (batch)")
    add(
        "--base",
        metavar="LINK",
        help="the base floats, and this is its link (or one fixed to it); its motion is in the "
        "recording: Imu, or AccelStamped with TwistStamped or Odometry, on any topic",
    )
    add(
        "--base-wrench",
        choices=("zero", "unknown"),
        default="unknown",
        help="what pushes a floating base: zero in free motion; unknown (default), as where it "
        "stands or hangs: only the joints' torques are learned from",
    )
    add(
        "--imu",
        action="append",
        default=[],
        metavar="TOPIC=LINK",
        help="an Imu glued on a link, anyhow; may be repeated. Needed where the messages' frame "
        "does not name the link; none: take no notice of any",
    )
    held_out = parser.add_mutually_exclusive_group()
    held_out.add_argument("--validate", type=Path, metavar="LOG", help="score on this recording")
    held_out.add_argument(
        "--validate-from", type=float, metavar="S", help="learn before this second, score after it"
    )
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> None:
    if args.every > 1 and args.mode == "sample":
        raise UsageError("--every needs mode moments; have: --mode moments, or --every 1")
    alone = {"--base": args.base, "--imu": args.imu, "--validate-from": args.validate_from}
    given = [option for option, value in alone.items() if value]
    args.logs = check_logs(*args.logs)
    if given and len(args.logs) > 1:
        raise UsageError(f"{', '.join(given)} go with one LOG, not with several")
    check_told(args)
    check_learning(args)
    check_logs(args.validate)
