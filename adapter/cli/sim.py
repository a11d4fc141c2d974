"""`adapter sim`: simulated hardware on this machine, behind the wire protocol of the real one."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import NamedTuple

from adapter.cli.parser import Parser
from adapter.shadowed import own_name


class Served(NamedTuple):
    """An arm that can be served: in words; modules with its options, and with what carries it out.

    They are loaded by name when they are needed: the second one brings PyBullet.
    """

    words: str
    options: str
    command: str


ARMS = {
    "fci": Served(
        "a Franka robot: FCI protocol 5 (Panda, FER) or 10 (FR3), on 127.0.0.1",
        "sim.fci.faults",
        "sim.fci.server",
    ),
    "can": Served(
        "an arm of Damiao motors in MIT mode, on a python-can bus",
        "sim.damiao.faults",
        "sim.damiao.server",
    ),
    "ros2": Served(
        "an arm behind ros2_control: joint states and an effort controller, over DDS on loopback",
        "sim.ros2.options",
        "sim.ros2.arm",
    ),
}


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare what is common to all arms."""
    kinds = " ".join(f"{name}: {served.words}." for name, served in ARMS.items())
    parser.description = (
        "Serve a simulated arm to drivers and to other people's clients, on this machine only, "
        f"until SIGTERM or Ctrl-C. {kinds}"
    )
    parser.epilog = "adapter sim ARM --help tells more."
    parser.add_argument("arm", choices=tuple(ARMS), metavar="ARM", help=", ".join(ARMS))
    parser.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="options of the arm")
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> None:
    """The arm's own options. Raises ValueError, DriverError with the choices."""
    served = ARMS[args.arm]
    options = import_module(own_name(served.options))
    said = f"Serve {served.words}, until SIGTERM or Ctrl-C."
    parser = Parser(prog=f"adapter sim {args.arm}", description=said)
    options.add_arguments(parser)
    args.asked = parser.parse_args(args.rest)
    options.check(args.asked)


def run(args: argparse.Namespace) -> int:
    """Serve; returns the exit code."""
    return int(import_module(own_name(ARMS[args.arm].command)).run(args.asked))
