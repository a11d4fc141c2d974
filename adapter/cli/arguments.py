"""The whole command line, and what is wrong with it at first sight.

Nothing here brings a library that takes long to load: wrong use is answered at once.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from adapter.cli.sim import ARMS as SERVED
from adapter.errors import UsageError
from adapter.experiments import arguments as experiments
from adapter.model.robots import names as robot_names
from adapter.runs.terminal import program_version
from drivers.registry import SCHEMES, split_address

MODES = ("moments", "sample")  # of `adapter.learning.learner`
FEEDFORWARD = ("none", "documented", "learned")
SIMULATED = ("panda",)
NAMES = "adapter.cli.names"  # brings NumPy; loaded by name where there is a name to look up
MODEL_FILES = (".urdf", ".xml", ".json")


def build_parser() -> argparse.ArgumentParser:
    """The command line; what it returns carries `command` and `check`, which may raise."""
    parser = argparse.ArgumentParser(
        prog="adapter",
        description="Lets a torque-sensed arm learn its own body while it moves.",
        epilog="adapter COMMAND --help tells more",
    )
    parser.add_argument("--version", action="version", version=program_version())
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (declare, words) in COMMANDS.items():
        part = commands.add_parser(name, help=words)
        part.set_defaults(check=_nothing_wrong)
        declare(part)
    return parser


def _nothing_wrong(args: argparse.Namespace) -> None:
    """Of a command without checks."""


def _run(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Move an arm on smooth random trajectories (or only listen) and learn λ and θ at its "
        "rate, in real time. Exit codes: 0 done, 2 wrong use, 3 the arm failed, 4 the learner "
        "failed."
    )
    add = parser.add_argument
    add(
        "--driver",
        default="pybullet:panda",
        metavar="ADDRESS",
        help="pybullet:panda (default), log:FILE, fci://HOST, can://CHANNEL?interface=...",
    )
    add(
        "--allow-motion",
        action="store_true",
        help="leave to move an arm that may be real (fci, can): prints the plan, goes at a tenth "
        "of the speed for 10 s, stops when this terminal closes. Without it, only listen",
    )
    add("--duration", type=float, default=30.0, metavar="S", help="default 30")
    add(
        "--scenario",
        metavar="NAME",
        help="of the simulated arm: nominal, bent_link, payload_at_20s, friction, wall_mounted "
        "(whose mounting is to be told: --gravity 9.81 0 0)",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the scenario, as in --set mass=0.3 --set noise=none",
    )
    add("--passive", action="store_true", help="only listen; do not move the arm")
    add("--fault", metavar="LIST", help="inject faults into the samples, as in lost=0.01,nan=0.001")
    add(
        "--feedforward",
        choices=FEEDFORWARD,
        default="none",
        help="model that helps the controller; its worth is told as tracking error",
    )
    add("--record", type=Path, metavar="FILE", help="default: in the results")
    add("--no-record", action="store_true", help="keep no recording")
    add("--checkpoint", type=Path, metavar="FILE", help="keep the learner's state")
    _add_learning(parser)
    parser.set_defaults(check=_check_run)


def _check_run(args: argparse.Namespace) -> None:
    if not args.duration > 0.0:
        raise UsageError(f"--duration must be above zero, got {args.duration}")
    scheme, rest = split_address(args.driver)
    if scheme not in SCHEMES:
        raise UsageError(f"no driver '{scheme}'; have: {', '.join(SCHEMES)}")
    if scheme == "pybullet" and rest not in SIMULATED:
        raise UsageError(f"no simulated arm '{rest}'; have: {', '.join(SIMULATED)}")
    if (args.scenario or args.set) and not simulated(args.driver):
        raise UsageError(
            f"--scenario and --set need --driver pybullet:..., not {args.driver}; for a served "
            "arm give them to `adapter sim`"
        )
    for option in args.set:
        if "=" not in option:
            raise UsageError(f"'{option}' is not KEY=VALUE")
    _check_learning(args)
    if args.fault is not None or simulated(args.driver):
        import_module(NAMES).check_run(args)


def simulated(address: str) -> bool:
    """Whether an address names an arm that is simulated in the process itself.

    A virtual CAN bus lives in one process only, so its motors are simulated there.
    """
    scheme, _ = split_address(address)
    if scheme != "can":
        return scheme == "pybullet"
    _, _, query = address.partition("?")
    return "interface=virtual" in query.split("&")


def _add_learning(parser: argparse.ArgumentParser) -> None:
    """Options of everything that learns."""
    add = parser.add_argument
    add("--robot", metavar="NAME|FILE", help="panda (default), .urdf, .xml (MJCF) or .json")
    _add_joints(parser)
    add("--config", type=Path, metavar="FILE", help="settings in TOML")
    add("--mode", choices=MODES, help="moments (default) or the paper's sample")
    add(
        "--effects",
        metavar="LIST",
        help="effects learned beside θ: none, real, or names with commas between (a name that "
        "does not exist lists them)",
    )
    add(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="in base axes, m/s², of an arm that does not stand upright: on a wall 9.81 0 0",
    )
    add("--seed", type=int, help="of every random choice")
    add("--truth", type=Path, metavar="FILE", help="model or truth to compare with")
    _add_results(parser)
    add("--resume", type=Path, metavar="FILE", help="go on from a checkpoint")


def _add_joints(parser: argparse.ArgumentParser) -> None:
    """Which joints of the model move; those that a recording lacks are locked at zero."""
    add = parser.add_argument
    add("--joints", metavar="A,B,C", help="joints of the model that move; the others are locked")
    add(
        "--lock",
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="lock a joint at a value, rad or m (default: zero where a recording lacks it)",
    )


def joints_of(args: argparse.Namespace) -> tuple[str, ...] | None:
    """Names given to `--joints`."""
    if args.joints is None:
        return None
    return tuple(name.strip() for name in args.joints.split(",") if name.strip())


def locks_of(args: argparse.Namespace) -> dict[str, float]:
    """Values given to `--lock` by joint. Raises UsageError."""
    values = {}
    for option in args.lock:
        name, _, text = option.rpartition("=")
        try:
            values[name.strip()] = float(text)
        except ValueError:
            name = ""
        if not name.strip() or not math.isfinite(values[name.strip()]):
            raise UsageError(f"--lock '{option}' is not JOINT=VALUE, a number in rad or m")
    return values


def _add_results(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    _add_json(parser)
    add("--out", type=Path, metavar="FOLDER", help="where results go")
    add("--no-report", action="store_true", help="do not write the HTML page")
    add("--quiet", action="store_true", help="no progress")


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")


def _check_learning(args: argparse.Namespace) -> None:
    locks_of(args)
    if args.robot is not None:
        _check_robot(args.robot)
    _check_files(args.config, args.truth, args.resume)
    if args.effects is not None or args.config is not None:
        import_module(NAMES).check_learning(args)


def _check_robot(name: str) -> None:
    if name in robot_names():
        return
    if Path(name).suffix.lower() not in MODEL_FILES:
        raise UsageError(
            f"no robot '{name}'; have: {', '.join(robot_names())}, a .urdf file, an MJCF file "
            "(.xml) or a .json model file"
        )
    _check_files(Path(name))


def _check_files(*paths: Path | None) -> None:
    for path in paths:
        try:
            if path is not None:
                path.open("rb").close()
        except OSError as error:
            raise UsageError(f"{path}: cannot be read: {error.strerror}") from None


def _replay(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Learn λ and θ from an MCAP recording, sample by sample as the live process does (the "
        "result is the same), or in batches."
    )
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="MCAP recording, ours or not")
    _add_learning(parser)
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
    held_out = parser.add_mutually_exclusive_group()
    held_out.add_argument("--validate", type=Path, metavar="LOG", help="score on this recording")
    held_out.add_argument(
        "--validate-from", type=float, metavar="S", help="learn before this second, score after it"
    )
    parser.set_defaults(check=_check_replay)


def _check_replay(args: argparse.Namespace) -> None:
    if args.every > 1 and args.mode == "sample":
        raise UsageError("--every needs mode moments; have: --mode moments, or --every 1")
    _check_learning(args)
    _check_files(args.log, args.validate)


def _gap(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Find where a model and recordings disagree, name the effects that the model lacks, add "
        "them, and measure the gap again on data that the fit never saw. Of several recordings "
        "the last one is held out; of one, blocks of it. Exit codes: 0 analysed, also where too "
        "little moves to tell anything; 2 wrong use, or a recording that does not fit the model "
        "(another robot, flipped signs, other units)."
    )
    add = parser.add_argument
    add("logs", nargs="+", type=Path, metavar="LOG", help="MCAP recording")
    add(
        "--model",
        required=True,
        metavar="MODEL",
        help="self model (.json), .urdf, .xml (MJCF), or a robot known by name: panda",
    )
    _add_joints(parser)
    add(
        "--inertia-prior",
        type=float,
        metavar="SHARE",
        help="standard deviation of the model's inertial numbers, of their size (default 0.02)",
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
        default="pybullet",
        choices=("pybullet", "mujoco"),
        help="of the forward simulation (default pybullet; mujoco is the extra [mujoco])",
    )
    add("--no-simulation", action="store_true", help="compare torques only")
    _add_results(parser)
    parser.set_defaults(check=_check_gap)


def _check_gap(args: argparse.Namespace) -> None:
    if args.validate_from is not None and len(args.logs) > 1:
        raise UsageError("--validate-from splits one LOG; of several the last one is held out")
    locks_of(args)
    _check_robot(args.model)
    _check_files(*args.logs)


def _load(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Weigh what the hand carries from the first sample of a recording on: mass, centre and "
        "inertia with standard deviations, and the lines that Franka and Universal Robots take. "
        "Without --empty the documented arm is the reference."
    )
    add = parser.add_argument
    add("log", type=Path, metavar="LOG", help="MCAP recording with the load, moving or at rest")
    add("--empty", type=Path, metavar="LOG", help="of the same arm without it: errors cancel")
    add("--robot", metavar="NAME|FILE", help="documented robot; the log's own, else panda")
    _add_joints(parser)
    add("--frame", metavar="NAME", help="in whose axes (default: the flange of the last link)")
    add(
        "--inertia-prior",
        type=float,
        metavar="SHARE",
        help="standard deviation of the model's inertial numbers, of their size (default 0.03; "
        "0.2 with --empty)",
    )
    add("--json", type=Path, metavar="FILE|-", help="write the figures; - to the standard output")
    parser.set_defaults(check=_check_load)


def _check_load(args: argparse.Namespace) -> None:
    locks_of(args)
    if args.inertia_prior is not None and not 0.0 < args.inertia_prior <= 1.0:
        raise UsageError(f"--inertia-prior must be in (0, 1], got {args.inertia_prior}")
    if args.robot is not None:
        _check_robot(args.robot)
    _check_files(args.log, args.empty)


def _diff(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "What differs from model A to model B, joint by joint: frames, inertias and effects, by "
        "how many standard deviations, whether any data could show it, and what it does to torques "
        "and to the hand's place. Of one model alone: from its documentation to it."
    )
    add = parser.add_argument
    add("first", metavar="A", help="model file (.json), robot file or known name")
    add("second", nargs="?", metavar="B", help="the same; without it A and its documentation")
    _add_joints(parser)
    add("--json", type=Path, metavar="FILE|-", help="write the figures; - to the standard output")
    parser.set_defaults(check=_check_diff)


def _check_diff(args: argparse.Namespace) -> None:
    locks_of(args)
    for name in (args.first, args.second):
        if name is not None:
            _check_robot(name)


def _discover(parser: argparse.ArgumentParser) -> None:
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
    add("--cutoff", type=float, metavar="HZ", help="of the filter, default 20")
    add(
        "--base",
        metavar="LINK",
        help="the link that carries all others; needed for a floating base whose links' frames "
        "do not turn about their z",
    )
    add("--model", type=Path, metavar="FILE", help="write the self model (.json)")
    _add_json(parser)
    parser.set_defaults(check=lambda args: _check_files(args.log))


def _sim(parser: argparse.ArgumentParser) -> None:
    kinds = " ".join(f"{name}: {served.words}." for name, served in SERVED.items())
    parser.description = (
        "Serve a simulated arm to drivers and to other people's clients, on this machine only, "
        f"until SIGTERM or Ctrl-C. {kinds}"
    )
    parser.epilog = "adapter sim ARM --help tells more"
    parser.add_argument("arm", choices=tuple(SERVED), metavar="ARM", help=", ".join(SERVED))
    parser.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="options of the arm")


def _import(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Turn CSV, whitespace tables or .npz into an MCAP recording. Sources are one FILE, or "
        "SIGNAL=FILE for each of time, q, dq, tau."
    )
    add = parser.add_argument
    add("sources", nargs="+", metavar="[SIGNAL=]FILE")
    add("--to", type=Path, required=True, metavar="FILE", help="recording to write")
    add("--columns", default="", metavar="MAP", help="as in time=0,q=1:8,dq=8:15,tau=tau_*")
    add("--units", default="", metavar="MAP", help="as in q=deg,tau=mNm,time=ms")
    add("--robot", metavar="NAME|FILE", help="take the joint names from this robot, in its order")
    add("--joints", default="", metavar="LIST", help="joint names, commas between")
    add("--flat", action="store_true", help="one value per line")
    add("--period", type=float, metavar="S", help="where there is no time")
    add("--overwrite", action="store_true", help="replace an existing recording")
    _add_json(parser)
    parser.set_defaults(check=_check_import)


def _check_import(args: argparse.Namespace) -> None:
    for source in args.sources:
        if not Path(source).exists():
            _check_files(Path(source.partition("=")[2] or source))
    if args.robot is not None:
        _check_robot(args.robot)


def _export(parser: argparse.ArgumentParser) -> None:
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
    _add_json(parser)
    parser.set_defaults(check=_check_export)


def _check_export(args: argparse.Namespace) -> None:
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
    _check_files(args.model, args.onto)


def _report(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="results of run or replay")
    parser.add_argument("--html", type=Path, metavar="FILE", help="default: FOLDER/report.html")
    _add_json(parser)
    parser.set_defaults(check=_check_report)


def _check_report(args: argparse.Namespace) -> None:
    if not args.folder.is_dir():
        raise UsageError(f"{args.folder}: no such run folder; `run` and `replay` write one")


def _recover(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--to", type=Path, metavar="FILE", help="default: NAME.recovered.mcap")
    _add_json(parser)
    parser.set_defaults(check=_check_file)


def _check_file(args: argparse.Namespace) -> None:
    _check_files(args.file)


def _info(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE")
    _add_json(parser)
    parser.set_defaults(check=_check_file)


# name -> (what declares its arguments, one line of help), in the order of --help
COMMANDS: dict[str, tuple[Callable[[argparse.ArgumentParser], None], str]] = {
    "run": (_run, "learn live"),
    "replay": (_replay, "learn from a recording"),
    "gap": (_gap, "find what a model lacks"),
    "load": (_load, "what the hand carries, to type into the robot"),
    "diff": (_diff, "two models of one arm, joint by joint"),
    "discover": (_discover, "find the tree of a robot from the motion of its links"),
    "sim": (_sim, "simulated hardware behind real wire protocols"),
    "import": (_import, "turn tables into a recording"),
    "export": (_export, "write a model file as URDF"),
    "report": (_report, "make the HTML page of a run again"),
    "recover": (_recover, "mend a recording that was cut"),
    "info": (_info, "what is in a recording or a model file"),
    "experiment": (experiments.experiment, "rerun the paper's experiments"),
    "bench": (experiments.bench, "time the update beside its rivals"),
}
