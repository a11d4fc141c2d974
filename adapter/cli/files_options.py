"""Options of `adapter import`, `recover` and `info`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import (
    add_joints,
    add_json,
    add_told,
    add_topic,
    check_files,
    check_robot,
    check_told,
    names_in,
)


def declare_import(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Turn tables (CSV, white space, either packed by gzip, .npz, .parquet, or the folder of a "
        "LeRobot data set) or a bag (rosbag2, ROS 1, MCAP) into an MCAP recording of our own. "
        "Sources are one FILE, or of tables SIGNAL=FILE for each of time, q, dq, tau."
    )
    add = parser.add_argument
    add("sources", nargs="+", metavar="[SIGNAL=]FILE")
    add("--to", type=Path, required=True, metavar="FILE", help="recording to write")
    _add_tables(parser)
    add_topic(parser)
    add("--robot", metavar="NAME|FILE", help="take the joint names from this robot, in its order")
    add("--joints", type=names_in, default=(), metavar="LIST", help="joint names, commas between")
    add("--flat", action="store_true", help="one value per line")
    add("--overwrite", action="store_true", help="replace an existing recording")
    add_json(parser)
    parser.set_defaults(check=_check_import)


def _add_tables(parser: argparse.ArgumentParser) -> None:
    """Where tables have which signal."""
    add = parser.add_argument
    add("--columns", default="", metavar="MAP", help="as in time=0,q=1:8,dq=8:15,tau=tau_*")
    add("--units", default="", metavar="MAP", help="as in q=deg,tau=mNm,time=ms")
    add("--period", type=float, metavar="S", help="where there is no time")
    add("--episode", type=int, metavar="N", help="of a LeRobot data set with several")


def _check_import(args: argparse.Namespace) -> None:
    for source in args.sources:
        if not Path(source).exists():
            check_files(Path(source.partition("=")[2] or source))
    if args.robot is not None:
        check_robot(args.robot)


def declare_recover(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--to", type=Path, metavar="FILE", help="default: NAME.recovered.mcap")
    add_json(parser)
    parser.set_defaults(check=_check_file)


def declare_info(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "What is in a recording or a model file. With --robot also what the recording can teach "
        "of that arm: which combinations of parameters, how sure, and what is missing."
    )
    parser.add_argument("file", type=Path, metavar="FILE")
    add_topic(parser)
    _add_tables(parser)
    parser.add_argument("--robot", metavar="NAME|FILE", help="predict what the recording teaches")
    add_joints(parser)
    add_told(parser)
    add_json(parser)
    parser.set_defaults(check=_check_info)


def _check_info(args: argparse.Namespace) -> None:
    check_told(args)
    if args.robot is not None:
        check_robot(args.robot)
    if not args.file.is_dir():
        check_files(args.file)


def _check_file(args: argparse.Namespace) -> None:
    check_files(args.file)
