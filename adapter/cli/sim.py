"""`adapter sim`: simulated hardware on this machine, behind the wire protocol of the real one."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any

ARMS = {  # what is served, and the module that does it; imported only when it is asked for
    "fci": ("a Franka robot: FCI protocol 5 (Panda, FER) or 10 (FR3), on 127.0.0.1", "sim.fci"),
    "can": ("an arm of Damiao motors in MIT mode, on a python-can bus", "sim.damiao"),
}


def add_parser(commands: Any) -> None:
    """Declare the subcommand."""
    parser = commands.add_parser(
        "sim",
        help="simulated hardware behind real wire protocols",
        description="Serve a simulated arm to drivers and to other people's clients, on this "
        "machine only, until SIGTERM or Ctrl-C. " + _choices(),
        epilog="adapter sim ARM --help tells more",
    )
    parser.add_argument("arm", choices=tuple(ARMS), metavar="ARM", help=", ".join(ARMS))
    parser.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="options of the arm")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serve; returns the exit code."""
    what, package = ARMS[args.arm]
    command = import_module(f"{package}.command")
    parser = argparse.ArgumentParser(
        prog=f"adapter sim {args.arm}", description=f"Serve {what}, until SIGTERM or Ctrl-C."
    )
    command.add_arguments(parser)
    return int(command.run(parser.parse_args(args.rest)))


def _choices() -> str:
    return " ".join(f"{name}: {what}." for name, (what, _) in ARMS.items())
