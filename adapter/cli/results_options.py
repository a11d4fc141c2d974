"""Options of `adapter export` and `report`."""

from __future__ import annotations

import argparse
from pathlib import Path

from adapter.cli.options import add_json, check_files
from adapter.errors import UsageError


def declare_export(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Write a model as URDF or MJCF. Onto the robot's file (INPUT, or by default the one that "
        "the model came from) only what was learned is written: inertials, places of joints, "
        "friction; every other byte stays as it is."
    )
    add = parser.add_argument
    add("model", type=Path, metavar="MODEL", help="model file (.json)")
    add("--urdf", type=Path, metavar="FILE", help="to write")
    add("--mjcf", type=Path, metavar="FILE", help="to write")
    onto = parser.add_mutually_exclusive_group()
    onto.add_argument(
        "--onto",
        type=Path,
        metavar="INPUT",
        help="the robot's file, .urdf or .xml (MJCF); written to INPUT.learned.urdf (.xml) where "
        "neither --urdf nor --mjcf is given",
    )
    onto.add_argument("--alone", action="store_true", help="the arm alone, without pictures")
    add_json(parser)
    parser.set_defaults(check=_check_export)


def _check_export(args: argparse.Namespace) -> None:
    if args.model.suffix != ".json":
        raise UsageError(f"{args.model}: give a model file (.json), as run and replay write it")
    if args.onto is None:
        if args.urdf is None and args.mjcf is None:
            raise UsageError("nothing to write; have: --urdf FILE, --mjcf FILE, --onto INPUT")
    elif args.onto.suffix not in (".urdf", ".xml"):
        raise UsageError(f"--onto {args.onto}: have: a .urdf file, an MJCF file (.xml)")
    elif args.urdf is None and args.mjcf is None:
        path = args.onto.with_suffix(f".learned{args.onto.suffix}")
        args.urdf, args.mjcf = (path, None) if path.suffix == ".urdf" else (None, path)
    elif (args.urdf if args.onto.suffix == ".urdf" else args.mjcf) is None:
        other = "--urdf" if args.onto.suffix == ".urdf" else "--mjcf"
        raise UsageError(f"--onto {args.onto} is written by {other} FILE")
    for option, path, other in (("--urdf", args.urdf, ".xml"), ("--mjcf", args.mjcf, ".urdf")):
        if path is not None and path.suffix == other:
            raise UsageError(f"{option} {path}: have: --urdf FILE.urdf, --mjcf FILE.xml")
    check_files(args.model, args.onto)


def declare_report(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="results of run or replay")
    parser.add_argument("--html", type=Path, metavar="FILE", help="default: FOLDER/report.html")
    add_json(parser)
    parser.set_defaults(check=_check_report)


def _check_report(args: argparse.Namespace) -> None:
    if not args.folder.is_dir():
        raise UsageError(f"{args.folder}: no such run folder; `run` and `replay` write one")
