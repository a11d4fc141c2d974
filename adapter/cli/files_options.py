"""Options of the commands on files: `adapter import`, `recover`, `info`, `export` and `report`."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path

from adapter.cli import options
from adapter.errors import UsageError


def declare_import(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Turn tables (CSV, white space, either packed by gzip, .npz, .parquet, or the folder of a "
        "LeRobot data set or of SAGE) or a bag (rosbag2, ROS 1, MCAP) into an MCAP recording of "
        "our own. Sources are one FILE, or of tables SIGNAL=FILE for each of time, q, dq, tau, "
        "cmd (commanded positions)."
    )
    add = parser.add_argument
    add("sources", nargs="+", metavar="[SIGNAL=]FILE")
    add("--to", type=Path, required=True, metavar="FILE", help="recording to write")
    _add_tables(parser)
    options.add_topic(parser)
    said = "the arm as documented, whose joints' names are taken, in its order"
    add("--robot", metavar="NAME|FILE", help=said)
    said = "joint names, commas between"
    add("--joints", type=options.names_in, default=(), metavar="A,B,C", help=said)
    said = "joints that are called otherwise: A in the source, B here; LEFT_*=* takes off a prefix"
    add("--names", type=options.names_in, default=(), metavar="A=B,...", help=said)
    add("--flat", action="store_true", help="one value per line")
    add("--overwrite", action="store_true", help="replace an existing recording")
    options.add_json(parser)
    parser.set_defaults(check=_check_import)


def _add_tables(parser: argparse.ArgumentParser) -> None:
    """Where tables have which signal."""
    add = parser.add_argument
    add("--columns", default="", metavar="MAP", help="as in time=0,q=1:8,dq=8:15,tau=tau_*")
    add("--units", default="", metavar="MAP", help="as in q=deg,tau=mNm,time=ms")
    add("--period", type=float, metavar="S", help="where there is no time")
    add("--rate", dest="period", type=_period_of, metavar="HZ", help="the same")
    add("--episode", type=int, metavar="N", help="of a LeRobot data set with several")


def _period_of(text: str) -> float:
    """The period of a rate. Raises ArgumentTypeError."""
    with suppress(ValueError):
        if float(text) > 0.0:
            return 1.0 / float(text)
    raise argparse.ArgumentTypeError(f"'{text}' is no rate in Hz")


def _check_import(args: argparse.Namespace) -> None:
    for source in args.sources:
        if not Path(source).exists():
            options.check_files(Path(source.partition("=")[2] or source))
    options.check_robot(args.robot)


def declare_recover(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--to", type=Path, metavar="FILE", help="default: NAME.recovered.mcap")
    options.add_json(parser)
    parser.set_defaults(check=lambda args: options.check_files(args.file))


def declare_info(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "What is in a recording or a model file. With --robot also what the recording can teach "
        "of that arm: which combinations of parameters, how sure, and what is missing."
    )
    parser.add_argument("file", type=Path, metavar="FILE")
    options.add_topic(parser)
    _add_tables(parser)
    options.add_robot(parser, "none, and nothing is said of what the recording teaches")
    options.add_told(parser)
    options.add_json(parser)
    parser.set_defaults(check=_check_info)


def _check_info(args: argparse.Namespace) -> None:
    options.check_told(args)
    options.check_robot(args.robot)
    if not args.file.is_dir():
        options.check_files(args.file)


FORMATS = {  # how a file of each ends, and what it is
    "urdf": (".urdf", "URDF to write"),
    "mjcf": (".xml", "MJCF to write, of MuJoCo"),
    "sdf": (".sdf", "SDF to write, of Gazebo: the arm alone"),
    "usd": (".usda", "USD to write: the arm alone, or a layer --onto ASSET.usd (extra [usd])"),
    "isaac": (".py", "what joints have, as Isaac Lab's actuators (Python), to write"),
    "c": (".c", "the arm's torque in C99, bodies and effects: feed-forward, what no format holds"),
}


def declare_export(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Write a model for simulators. Onto the robot's file (INPUT, or by default the URDF or "
        "MJCF that the model came from) only what was learned is written: inertials, places of "
        "joints, friction, and what is missing as a comment; every other byte stays as it is. With "
        "--servo a robot is written whose joints follow position commands as its servos do. Or "
        "write a recording as a data set of LeRobot."
    )
    add = parser.add_argument
    what = "model file (.json), with --servo any robot, or a recording"
    add("model", type=Path, metavar="MODEL|LOG", help=what)
    said = "servo.toml of gap: MuJoCo's position actuators, delay, friction, armature, ground"
    add("--servo", type=Path, metavar="FILE", help=said)
    add("--lerobot", type=Path, metavar="FOLDER", help="of LOG: a data set, version 3, to write")
    for kind, (_, said) in FORMATS.items():
        add(f"--{kind}", type=Path, metavar="FILE", help=said)
    said = "models drawn from what is known of MODEL; --urdf, --mjcf... name a folder: 0000.urdf"
    add("--samples", type=int, metavar="N", help=said)
    add("--seed", type=int, default=0, help="of the samples")
    said = "means, standard deviations, and the directions that make torques unsure, JSON to write"
    add("--ranges", type=Path, metavar="FILE", help=said)
    onto = parser.add_mutually_exclusive_group()
    onto.add_argument(
        "--onto",
        type=Path,
        metavar="INPUT",
        help="the robot's file, .urdf, .xml (MJCF) or .usd; written to INPUT.learned.urdf (.xml, "
        ".usda) where no option says so",
    )
    onto.add_argument("--alone", action="store_true", help="the arm alone, without pictures")
    options.add_json(parser)
    parser.set_defaults(check=_check_export)


def _check_export(args: argparse.Namespace) -> None:
    asked = {kind: path for kind in FORMATS if (path := getattr(args, kind)) is not None}
    if args.lerobot is not None:
        if asked or any((args.onto, args.alone, args.servo, args.ranges, args.samples)):
            raise UsageError("--lerobot is for a recording and goes with no other file")
        return
    if args.samples is not None and (args.servo is not None or args.samples < 1):
        raise UsageError("--samples N (1 or more) are drawn from a learned model, not of --servo")
    if args.samples is not None and not asked.keys() - {"c"}:
        raise UsageError("--samples need a folder: --urdf FOLDER, --mjcf FOLDER")
    if args.servo is not None:
        options.check_robot(str(args.model))
        if asked.keys() - {"urdf", "mjcf"}:
            raise UsageError("--servo goes with --urdf FILE and --mjcf FILE")
    elif args.model.suffix != ".json":
        raise UsageError(f"{args.model}: give a model file (.json), as run and replay write it")
    if args.onto is None and not asked and args.ranges is None:
        have = ", ".join(f"--{kind} FILE" for kind in FORMATS)
        raise UsageError(f"nothing to write; have: {have}, --onto INPUT, --ranges FILE")
    if args.onto is not None:
        ends = args.onto.suffix[:4]  # of .usda and .usdc as of .usd
        kind = {".urd": "urdf", ".xml": "mjcf", ".usd": "usd"}.get(ends)
        if kind is None:
            raise UsageError(f"--onto {args.onto}: have: a .urdf file, an MJCF file (.xml), a .usd")
        if not asked.keys() & {"urdf", "mjcf", "usd"}:
            asked[kind] = args.onto.with_suffix(f".learned{FORMATS[kind][0]}")
            setattr(args, kind, asked[kind])
        elif kind not in asked:
            raise UsageError(f"--onto {args.onto} is written by --{kind} FILE")
    for kind, path in asked.items():
        if path.suffix in {x for x, _ in FORMATS.values()} - {FORMATS[kind][0]}:
            have = ", ".join(f"--{x} FILE{ends}" for x, (ends, _) in FORMATS.items())
            raise UsageError(f"--{kind} {path}: have: {have}")
    options.check_files(args.model if args.servo is None else None, args.servo, args.onto)


def declare_report(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="results of run or replay")
    parser.add_argument("--html", type=Path, metavar="FILE", help="default: FOLDER/report.html")
    options.add_json(parser)
    parser.set_defaults(check=_check_report)


def _check_report(args: argparse.Namespace) -> None:
    if not args.folder.is_dir():
        raise UsageError(f"{args.folder}: no such run folder; `run` and `replay` write one")
