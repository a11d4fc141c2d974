"""Options of `adapter discover`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import add_json, add_topic, check_logs
from adapter.errors import UsageError

READ_S = 120.0  # as long as a recording that other commands hold in memory


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "From joint signals and link motion in unknown order find which joint moves which link "
        "and who is whose parent, each with a confidence; say what the data leave open; then "
        "learn λ, and θ where torques were recorded."
    )
    add = parser.add_argument
    add(
        "log",
        type=Path,
        metavar="LOG",
        help="MCAP recording with link motion: Imu topics, "
        "or /link_twists/<link> and /link_accels/<link>",
    )
    add_topic(parser)
    add("--from", dest="from_s", type=float, default=0.0, metavar="S", help="begin at this second")
    add(
        "--seconds",
        type=float,
        default=READ_S,
        metavar="S",
        help=f"read so many seconds, default {READ_S:g}; all of them are held in memory",
    )
    add("--cutoff", type=float, metavar="HZ", help="of the filter, default 20")
    add(
        "--base",
        metavar="LINK",
        help="the link that carries all others; needed for a floating base whose links' frames "
        "do not turn about their z",
    )
    add("--model", type=Path, metavar="FILE", help="write the self model (.json)")
    add_json(parser)
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> list[Path]:
    if not args.from_s >= 0.0:
        raise UsageError(f"--from takes 0 or more seconds, got {args.from_s}")
    if not args.seconds > 0.0:
        raise UsageError(f"--seconds must be above zero, got {args.seconds}")
    return check_logs(args.log)
