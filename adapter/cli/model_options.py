"""Options of the commands that hold recordings and models beside each other.

`adapter gap`, `fleet`, `load`, `diff` and `discover`.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from adapter.cli import options
from adapter.errors import UsageError

READ_S = 120.0  # of `discover`: as long as a recording that other commands hold in memory


GAP_WORDS = {
    "--servo": "recordings of a position-controlled arm (commanded and measured positions, no "
    "torque): its servos as documented, TOML as the results' servo.toml (default: nobody "
    "documented them, commands should be where the arm is)",
    "--inertia-prior": "standard deviation of the model's inertial numbers, of their size "
    "(default 0.05, centres to 0.1 m times that; of a position-controlled arm 0.02)",
    "--hold-out": "score on these, fit all others (default: blocks of time are held out in turn)",
    "--beside": "results of other position-controlled arms of this kind: whose servos differ",
    "--rounds": "rounds of the search, in each of which something may be named (default 24)",
    "--simulator": "of the forward simulation (default pybullet where it is installed, extra "
    "[sim]; mujoco is the extra [mujoco])",
}


def declare_gap(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Find where a model and recordings disagree, name the effects that the model lacks, add "
        "them, and measure the gap again on data that the fit never saw. Several "
        "recordings are of one arm: friction, inertias and offsets are common, what the hand "
        "carries and what pushes it is each one's own. A recording in which too little moves to "
        "tell anything is an answer too; one that does not fit the model (another robot, flipped "
        "signs, other units) cannot be used."
    )
    add = options.declaring(parser, GAP_WORDS)
    add("logs", nargs="+", type=Path, metavar="LOG", help="recording, or a folder of such")
    options.add_topic(parser)
    options.add_robot(parser, "", "model")
    add("--servo", type=Path, metavar="FILE")
    options.add_told(parser)
    add("--inertia-prior", type=float, metavar="SHARE")
    add("--hold-out", nargs="+", action="extend", default=[], type=Path, metavar="LOG")
    add("--beside", nargs="+", action="extend", default=[], type=Path, metavar="RESULTS")
    add("--validate-from", type=float, metavar="S", help="fit before this second, score after it")
    add("--rounds", type=int, metavar="N")
    add_effects(parser)
    add("--simulator", choices=("pybullet", "mujoco"))
    add("--no-simulation", action="store_true", help="compare torques only")
    options.add_results(parser)
    parser.set_defaults(check=_check_gap)


def _check_gap(args: argparse.Namespace) -> None:
    args.logs, args.hold_out = options.check_logs(*args.logs), options.check_logs(*args.hold_out)
    if args.validate_from is not None and (args.hold_out or len(args.logs) > 1):
        raise UsageError("--validate-from splits one LOG; of several, --hold-out names the scored")
    options.check_told(args)
    options.need_robot(args.model)


def declare_effects(parser: argparse.ArgumentParser) -> None:
    """Declare them."""
    parser.description = (
        "What effects can be named, one's own among them; `keep RESULT --as NAME` keeps a law "
        "that adapter gap found, under a name by which it is looked for in other recordings."
    )
    add = parser.add_argument
    add("keep", nargs="*", metavar="keep RESULT", help="results folder, or gap.json in it")
    add("--as", dest="name", metavar="NAME", help="what the law is called: hose_joint_3")
    add("--joint", type=int, metavar="J", help="whose law it is, where the result has several")
    add_effects(parser, Path("effects.toml"))


def add_effects(parser: argparse.ArgumentParser, default: Path | None = None) -> None:
    """The file of kept laws."""
    parser.add_argument(
        "--effects",
        dest="kept",
        type=Path,
        metavar="FILE",
        default=default,
        help="laws of one's own, TOML as `adapter effects keep` writes it"
        + (f" (default {default})" if default else ""),
    )


FLEET_WORDS = {
    "logs": "recording, folder (with those inside it), pattern ('logs/**/*.mcap'), or address "
    "that fsspec opens (s3://...); none: those of before alone",
    "--by": "what tells arms apart: the name or serial number in the log (default; the model's "
    "name where there is none), or the folder that it lies in",
    "--manifest": "a table with a column log, and arm, or numbers that friction may follow "
    "(temperature, age); goes before --by",
    "--workers": "processes on this machine (default: as many as it has processors; 0: none "
    "beside this one)",
}


def declare_fleet(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Learn one model per arm from many recordings, and tell what each of them carried, what "
        "drifts, which of them disagree, are broken, or would teach most once more. The moments "
        "of a recording are kept in --out: recordings join those of before, and none is read "
        "twice. λ is the model's."
    )
    add = options.declaring(parser, FLEET_WORDS)
    add("logs", nargs="*", metavar="LOG")
    options.add_topic(parser)
    options.add_robot(parser, "", "model")
    options.add_told(parser)
    add("--by", choices=("log", "folder"), default="log")
    add("--manifest", type=Path, metavar="CSV")
    for name, said in (
        ("--forget", "leave these out from now on, though they are gone or given"),
        ("--remember", "do not leave these out any more"),
    ):
        add(name, nargs="+", action="extend", default=[], metavar="LOG", help=said)
    add("--workers", type=int, default=os.cpu_count() or 1, metavar="N")
    add("--cluster", metavar="ADDRESS", help="of a Dask scheduler to send the tasks to")
    options.add_results(parser)
    parser.set_defaults(check=_check_fleet)


def _check_fleet(args: argparse.Namespace) -> None:
    options.need_robot(args.model)
    options.check_told(args)
    if args.learn_gains:
        raise UsageError("--tau-gain fit: learn gains with `gap` or `replay`, and give them here")
    if not args.logs and args.out is None:
        raise UsageError("give LOGs, or --out FOLDER with those of before")
    for option in ("forget", "remember"):
        if getattr(args, option) and args.out is None:
            raise UsageError(f"--{option} needs --out, the folder of the fleet that knows the LOG")
    if args.workers < 0:
        raise UsageError(f"--workers takes 0 or more, got {args.workers}")
    options.check_files(args.manifest)


LOAD_WORDS = {
    "--inertia-prior": "standard deviation of the model's inertial numbers, of their size "
    "(default 0.05; 0.2 with --empty)"
}


def declare_load(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Weigh what the hand carries from the first sample of a recording on: mass, centre and "
        "inertia with standard deviations, and the lines that Franka and Universal Robots take. "
        "Without --empty the documented arm is the reference."
    )
    add = options.declaring(parser, LOAD_WORDS)
    add("log", type=Path, metavar="LOG", help="recording with the load, moving or at rest")
    options.add_topic(parser)
    add("--empty", type=Path, metavar="LOG", help="of the same arm without it: errors cancel")
    options.add_robot(parser, "the log's own, else panda")
    options.add_told(parser)
    add("--frame", metavar="NAME", help="in whose axes (default: the flange of the last link)")
    add("--inertia-prior", type=float, metavar="SHARE")
    options.add_json(parser, or_output=True)
    parser.set_defaults(check=_check_load)


def _check_load(args: argparse.Namespace) -> None:
    options.check_told(args)
    if args.learn_gains and args.empty is None:
        raise UsageError("--tau-gain fit needs --empty LOG: gains and load cannot be told apart")
    if args.inertia_prior is not None and not 0.0 < args.inertia_prior <= 1.0:
        raise UsageError(f"--inertia-prior must be in (0, 1], got {args.inertia_prior}")
    options.check_robot(args.robot)
    options.check_logs(args.log, args.empty)


def declare_diff(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "What differs from model A to model B, joint by joint: frames, inertias and effects, by "
        "how many standard deviations, whether any data could show it, and what it does to torques "
        "and to the hand's place. Of one model alone: from its documentation to it."
    )
    add = parser.add_argument
    add("first", metavar="A", help="model file (.json), robot file or known name")
    add("second", nargs="?", metavar="B", help="the same; without it A and its documentation")
    options.add_joints(parser)
    options.add_json(parser, or_output=True)
    parser.set_defaults(check=lambda args: options.check_robot(args.first, args.second))


DISCOVER_WORDS = {
    "log": "MCAP recording with link motion: Imu topics, or /link_twists/<link> and "
    "/link_accels/<link>",
    "--seconds": f"read so many seconds, default {READ_S:g}; all of them are held in memory",
    "--base": "the link that carries all others; needed for a floating base whose links' frames "
    "do not turn about their z",
}


def declare_discover(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "From joint signals and link motion in unknown order find which joint moves which link "
        "and who is whose parent, each with a confidence; say what the data leave open; then "
        "learn λ, and θ where torques were recorded."
    )
    add = options.declaring(parser, DISCOVER_WORDS)
    add("log", type=Path, metavar="LOG")
    options.add_topic(parser)
    add("--from", dest="from_s", type=float, default=0.0, metavar="S", help="begin at this second")
    add("--seconds", type=float, default=READ_S, metavar="S")
    add("--cutoff", type=float, metavar="HZ", help="of the filter, default 20")
    add("--base", metavar="LINK")
    add("--model", type=Path, metavar="FILE", help="write what was learned, a model file (.json)")
    options.add_json(parser)
    parser.set_defaults(check=_check_discover)


def _check_discover(args: argparse.Namespace) -> list[Path]:
    if not args.from_s >= 0.0:
        raise UsageError(f"--from takes 0 or more seconds, got {args.from_s}")
    if not args.seconds > 0.0:
        raise UsageError(f"--seconds must be above zero, got {args.seconds}")
    return options.check_logs(args.log)
