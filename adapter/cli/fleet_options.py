"""Options of `adapter fleet`."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from adapter.cli.options import (
    add_joints,
    add_results,
    add_told,
    add_topic,
    check_files,
    check_robot,
    check_told,
)
from adapter.errors import UsageError


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Learn one model per arm from many recordings, and tell what each of them carried, what "
        "drifts, which of them disagree, are broken, or would teach most once more. The moments "
        "of a recording are kept in --out: recordings join those of before, and none is read "
        "twice. λ is the model's."
    )
    add = parser.add_argument
    add(
        "logs",
        nargs="*",
        metavar="LOG",
        help="recording, folder (with those inside it), pattern ('logs/**/*.mcap'), or address "
        "that fsspec opens (s3://...); none: those of before alone",
    )
    add_topic(parser)
    add(
        "--model", required=True, metavar="MODEL", help="self model, .urdf, MJCF, or a robot's name"
    )
    add_joints(parser)
    add_told(parser)
    add(
        "--by",
        choices=("log", "folder"),
        default="log",
        help="what tells arms apart: the name or serial number in the log (default; the model's "
        "name where there is none), or the folder that it lies in",
    )
    add(
        "--manifest",
        type=Path,
        metavar="CSV",
        help="a table with a column log, and arm, or numbers that friction may follow "
        "(temperature, age); goes before --by",
    )
    for name, said in (
        ("--forget", "leave these out from now on, though they are gone or given"),
        ("--remember", "do not leave these out any more"),
    ):
        add(name, nargs="+", action="extend", default=[], metavar="LOG", help=said)
    add(
        "--workers",
        type=int,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes on this machine (default: as many as it has processors; 0: none beside "
        "this one)",
    )
    add("--cluster", metavar="ADDRESS", help="of a Dask scheduler to send the tasks to")
    add_results(parser)
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> None:
    check_robot(args.model)
    check_told(args)
    if args.learn_gains:
        raise UsageError("--tau-gain fit: learn gains with `gap` or `replay`, and give them here")
    if not args.logs and args.out is None:
        raise UsageError("give LOGs, or --out FOLDER with those of before")
    for option in ("forget", "remember"):
        if getattr(args, option) and args.out is None:
            raise UsageError(f"--{option} needs --out, the folder of the fleet that knows the LOG")
    if args.workers < 0:
        raise UsageError(f"--workers takes 0 or more, got {args.workers}")
    check_files(args.manifest)
