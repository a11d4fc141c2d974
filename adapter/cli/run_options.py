"""Options of the commands that move an arm or learn: `adapter run`, `plan`, `excite`, `replay`."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from adapter.cli import options
from adapter.control.settings import DESIGNED, KINDS
from adapter.errors import UsageError
from adapter.model import robot_names
from drivers.errors import choices
from drivers.registry import OWN_KIND, SCHEMES, is_own, split_address, tells_no_robot

SIMULATED = ("panda",)
ANY = -1  # the usual port, or any other where that is taken
DEFAULT_PORT, MOST_PORT = 8765, 65535  # of Foxglove; of all
SHARE, LONGEST_S, RATE_HZ = 0.2, 300.0, 200.0  # of `excite`


RUN_WORDS = {
    "--driver": "pybullet:panda (default), log:FILE, fci://HOST, can://CHANNEL?interface=..., "
    "ros2:///joint_states, FILE.py:CLASS of your own",
    "--allow-motion": "leave to move an arm that may be real (fci, can, ros2): prints the plan, "
    "goes at a tenth of the speed for 10 s, stops when this terminal closes. Without it, only "
    "listen",
    "--trust-model": "move an arm that may be real although what it holds at rest is not the "
    "weight that the model says",
    "--excitation": "motion: random (default), or designed to teach most in the time",
    "--motion": "play this motion instead: a table of times and positions, or an MCAP with a "
    "JointTrajectory, as `adapter excite` writes both; slowed down where limits ask for it",
    "--duration": "default 30, or as long as --motion takes; where the arm moves slowly at first "
    "(excitation.slow_s), behind that",
    "--scenario": "of the simulated arm: nominal, as_built (as real ones differ), bent_link, "
    "payload_at_20s, friction, real_drives, wall_mounted (whose mounting is to be told: "
    "--gravity 9.81 0 0)",
    "--set": "option of the scenario, as in --set mass=0.3 --set noise=none",
    "--feedforward": "model that helps the controller (default none; for a designed motion "
    "documented); its worth is told as tracking error",
    "--view": "serve a page to watch the run on, on this machine alone (default port 8400, or "
    "another where that is taken; 0: any)",
    "--foxglove": "serve Foxglove's WebSocket protocol, which PlotJuggler takes too, on this "
    "machine alone (default port 8765; needs panda-adapter[live])",
    "--trust-log": "torques are as the model has them: what speaks against it is a warning",
}


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Move an arm on smooth trajectories (or only listen) and learn λ and θ at its "
        "rate, in real time."
    )
    add = options.declaring(parser, RUN_WORDS)
    add("--driver", default="pybullet:panda", metavar="ADDRESS")
    add("--allow-motion", action="store_true")
    add("--yes", action="store_true", help="move without being asked after the plan")
    add("--trust-model", action="store_true")
    add("--excitation", choices=KINDS)
    add("--motion", type=Path, metavar="FILE")
    options.add_motion(parser)
    add("--duration", type=float, metavar="S")
    add("--scenario", metavar="NAME")
    add("--set", action="append", default=[], metavar="KEY=VALUE")
    add("--passive", action="store_true", help="only listen; do not move the arm")
    add("--fault", metavar="LIST", help="inject faults into the samples, as in lost=0.01,nan=0.001")
    add("--feedforward", choices=("none", "documented", "learned"))
    add("--view", nargs="?", type=_port, const=ANY, metavar="PORT")
    add("--foxglove", nargs="?", type=_port, const=DEFAULT_PORT, metavar="PORT")
    add("--record", type=Path, metavar="FILE", help="default: in the results")
    add("--overwrite", action="store_true", help="replace an existing recording")
    add("--no-record", action="store_true", help="keep no recording")
    add("--trust-log", action="store_true")
    add("--checkpoint", type=Path, metavar="FILE", help="keep the learner's state")
    options.add_learning(parser)
    parser.set_defaults(check=_check)


def declare_plan(parser: argparse.ArgumentParser) -> None:
    """Those of `adapter plan`: the same command line shows what it would do."""
    declare(parser)
    parser.description = (
        "Where `adapter run` with these options would move the arm from where it stands, as lines "
        "and as a page; nothing moves."
    )
    parser.set_defaults(allow_motion=True)


def _port(text: str) -> int:
    """A port's number. Raises ValueError."""
    port = int(text)
    if not 0 <= port <= MOST_PORT:
        raise argparse.ArgumentTypeError(f"a port is 0 to {MOST_PORT}, got {port}")
    return port


def _check(args: argparse.Namespace) -> None:
    if args.motion is not None:
        options.check_files(args.motion)
        if args.excitation or args.range:
            raise UsageError("--motion says how the arm moves; leave --excitation and --range out")
    if args.duration is not None and not args.duration > 0.0:
        raise UsageError(f"--duration must be above zero, got {args.duration}")
    scheme, rest = split_address(args.driver)
    if is_own(scheme):
        options.check_files(Path(scheme))
    elif scheme not in SCHEMES:
        raise UsageError(f"no driver '{scheme}'; {choices(scheme, SCHEMES, OWN_KIND)}")
    if scheme == "pybullet" and rest not in SIMULATED:
        raise UsageError(f"no simulated arm '{rest}'; {choices(rest, SIMULATED)}")
    if (args.scenario or args.set) and not simulated(args.driver):
        raise UsageError(
            f"--scenario and --set need --driver pybullet:..., not {args.driver}; for a served "
            "arm give them to `adapter sim`"
        )
    for option in args.set:
        if "=" not in option:
            raise UsageError(f"'{option}' is not KEY=VALUE")
    unnamed = tells_no_robot(scheme) and args.robot is None and not simulated(args.driver)
    if args.allow_motion and unnamed:
        raise UsageError(
            f"an arm behind {args.driver} does not say which robot it is; --robot must, before it "
            f"may be moved: {', '.join(robot_names())} or the arm's own .urdf"
        )
    options.check_learning(args)
    if args.fault is not None or args.scenario or args.set:
        import_module(options.NAMES).check_run(args)


def simulated(address: str) -> bool:
    """Whether an address names an arm that is simulated in the process itself.

    A virtual CAN bus lives in one process only, so its motors are simulated there.
    """
    scheme, _ = split_address(address)
    if scheme != "can":
        return scheme == "pybullet"
    _, _, query = address.partition("?")
    return "interface=virtual" in query.split("&")


EXCITE_WORDS = {
    "--at": "where it starts, rad (default: where the first LOG does)",
    "--std": "wanted, of the parameters of a body of 1 kg, 10 cm across, and of an effect's "
    f"usual size (default {SHARE:g}: 0.2 kg, 0.02 kg m, 0.002 kg m², 0.2 N m of friction)",
    "--noise": "standard deviation of each joint's torque, N m (default: of the LOGs, else 0.3 "
    "%% of the effort limits)",
}


def declare_excite(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Design a motion inside all limits, clear of the cell and of the arm itself, that brings "
        "every parameter which torques show to a wanted standard deviation in the shortest time, "
        "going on from what LOGs tell already; or, with --gap, the motion that a gap report asks "
        "to be measured next. Writes it as CSV, as MCAP (trajectory_msgs/JointTrajectory) and as a "
        "page; nothing moves. `adapter run --excitation designed` moves an arm so."
    )
    add = options.declaring(parser, EXCITE_WORDS)
    add("logs", nargs="*", type=Path, metavar="LOG", help="recordings of the arm that are there")
    options.add_robot(parser)
    add("--config", type=Path, metavar="FILE", help="settings in TOML")
    add("--at", metavar="Q1,Q2,...")
    add("--std", type=float, default=SHARE, metavar="SHARE")
    add("--noise", metavar="S1,S2,...")
    add("--gap", type=Path, metavar="FILE", help="JSON of `adapter gap`: what to measure next")
    options.add_motion(parser)
    add("--seed", type=int, help="of the motion")
    add("--longest", type=float, default=LONGEST_S, metavar="S", help=f"default {LONGEST_S:g}")
    said = f"of points (default {RATE_HZ:g})"
    add("--rate", type=float, default=RATE_HZ, metavar="HZ", help=said)
    options.add_json(parser)
    add("--out", type=Path, metavar="FOLDER", help="where results go")
    parser.set_defaults(check=_check_excite, excitation=DESIGNED)


def _check_excite(args: argparse.Namespace) -> None:
    options.check_robot(args.robot)
    options.check_files(args.config, args.gap)
    args.logs = options.check_logs(*args.logs)
    args.at = options.numbers("--at", args.at, what="numbers")
    args.noise = options.numbers("--noise", args.noise)
    for name, least in (("std", 0.0), ("longest", 1.0), ("rate", 1.0)):
        if not getattr(args, name) > least:
            raise UsageError(f"--{name} must be above {least:g}, got {getattr(args, name)}")


REPLAY_WORDS = {
    "logs": "recording (MCAP, rosbag2, ROS 1), or a folder of such; several of one arm are "
    "learned from in order",
    "--base": "the base floats, and this is its link (or one fixed to it); its motion is in the "
    "recording: Imu, or AccelStamped with TwistStamped or Odometry, on any topic",
    "--base-wrench": "what pushes a floating base: zero in free motion; unknown (default), as "
    "where it stands or hangs: only the joints' torques are learned from",
    "--imu": "an Imu glued on a link, anyhow; may be repeated. Needed where the messages' frame "
    "does not name the link; none: take no notice of any",
}


def declare_replay(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Learn λ and θ from an MCAP recording, sample by sample as the live process does (the "
        "result is the same), or in batches."
    )
    add = options.declaring(parser, REPLAY_WORDS)
    add("logs", nargs="+", type=Path, metavar="LOG")
    options.add_topic(parser)
    options.add_learning(parser)
    options.add_told(parser)
    add("--every", type=int, default=1, metavar="N", help="one update per N samples (batch)")
    add("--base", metavar="LINK")
    add("--base-wrench", choices=("zero", "unknown"), default="unknown")
    add("--imu", action="append", default=[], metavar="TOPIC=LINK")
    held_out = parser.add_mutually_exclusive_group()
    held_out.add_argument("--validate", type=Path, metavar="LOG", help="score on this recording")
    held_out.add_argument(
        "--validate-from", type=float, metavar="S", help="learn before this second, score after it"
    )
    parser.set_defaults(check=_check_replay)


def _check_replay(args: argparse.Namespace) -> None:
    if args.every > 1 and args.mode == "sample":
        raise UsageError("--every needs mode moments; have: --mode moments, or --every 1")
    alone = {"--base": args.base, "--imu": args.imu, "--validate-from": args.validate_from}
    given = [option for option, value in alone.items() if value]
    args.logs = options.check_logs(*args.logs)
    if given and len(args.logs) > 1:
        raise UsageError(f"{', '.join(given)} go with one LOG, not with several")
    options.check_told(args)
    options.check_learning(args)
    options.check_logs(args.validate)
