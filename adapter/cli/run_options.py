"""Options of `adapter run`."""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

from adapter.cli.options import NAMES, add_learning, add_motion, check_files, check_learning
from adapter.control.settings import KINDS
from adapter.errors import UsageError
from adapter.model.robot_names import robot_names
from drivers.errors import choices
from drivers.registry import OWN_KIND, SCHEMES, is_own, split_address, tells_no_robot

FEEDFORWARD = ("none", "documented", "learned")
SIMULATED = ("panda",)
ANY = -1  # the usual port, or any other where that is taken
DEFAULT_PORT, MOST_PORT = 8765, 65535  # of Foxglove; of all


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "Move an arm on smooth trajectories (or only listen) and learn λ and θ at its "
        "rate, in real time."
    )
    add = parser.add_argument
    add(
        "--driver",
        default="pybullet:panda",
        metavar="ADDRESS",
        help="pybullet:panda (default), log:FILE, fci://HOST, can://CHANNEL?interface=..., "
        "ros2:///joint_states, FILE.py:CLASS of your own",
    )
    add(
        "--allow-motion",
        action="store_true",
        help="leave to move an arm that may be real (fci, can, ros2): prints the plan, goes at a "
        "tenth of the speed for 10 s, stops when this terminal closes. Without it, only listen",
    )
    add("--yes", action="store_true", help="move without being asked after the plan")
    add(
        "--trust-model",
        action="store_true",
        help="move an arm that may be real although what it holds at rest is not the weight that "
        "the model says",
    )
    add(
        "--excitation",
        choices=KINDS,
        help="motion: random (default), or designed to teach most in the time",
    )
    add_motion(parser)
    add(
        "--duration",
        type=float,
        default=30.0,
        metavar="S",
        help="default 30; where the arm moves slowly at first (excitation.slow_s), behind that",
    )
    add(
        "--scenario",
        metavar="NAME",
        help="of the simulated arm: nominal, bent_link, payload_at_20s, friction, real_drives, "
        "wall_mounted (whose mounting is to be told: --gravity 9.81 0 0)",
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
        help="model that helps the controller (default none; for a designed motion documented); "
        "its worth is told as tracking error",
    )
    add(
        "--view",
        nargs="?",
        type=_port,
        const=ANY,
        metavar="PORT",
        help="serve a page to watch the run on, on this machine alone (default port 8400, or "
        "another where that is taken; 0: any)",
    )
    add(
        "--foxglove",
        nargs="?",
        type=_port,
        const=DEFAULT_PORT,
        metavar="PORT",
        help="serve Foxglove's WebSocket protocol, which PlotJuggler takes too, on this machine "
        "alone (default port 8765; needs panda-adapter[live])",
    )
    add("--record", type=Path, metavar="FILE", help="default: in the results")
    add("--overwrite", action="store_true", help="replace an existing recording")
    add("--no-record", action="store_true", help="keep no recording")
    add(
        "--trust-log",
        action="store_true",
        help="torques are as the model has them: what speaks against it is a warning",
    )
    add("--checkpoint", type=Path, metavar="FILE", help="keep the learner's state")
    add_learning(parser)
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
    if not args.duration > 0.0:
        raise UsageError(f"--duration must be above zero, got {args.duration}")
    scheme, rest = split_address(args.driver)
    if is_own(scheme):
        check_files(Path(scheme))
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
    check_learning(args)
    if args.fault is not None or args.scenario or args.set:
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
