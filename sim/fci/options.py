"""What the simulated robot can be asked for; light, so that wrong use is told at once."""

from __future__ import annotations

import argparse
from typing import Any

from sim.faults import describe, read_fault
from sim.fci.codec import HOST, PORT, VERSIONS
from sim.fci.faults import KINDS
from sim.fci.gripper import WIDEST
from sim.options import add_served, options_of
from sim.options import check as check_scenario

ROBOT = {5: "panda", 10: "fr3"}  # by protocol


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add("--port", type=int, default=PORT, help=f"TCP port on {HOST}; clients know only {PORT}")
    words = "TCP port of the gripper; 1338, which clients know, where --port is 1337, else none"
    add("--gripper-port", type=int, default=None, metavar="PORT", help=words)
    words = "width of what lies between the gripper's fingers; 0 is nothing"
    add("--object", type=float, default=0.0, metavar="M", help=words)
    add("--protocol", type=int, choices=VERSIONS, default=5, help="5 Panda (FER), 10 FR3")
    add("--core", type=int, default=None, help="processor to stay on")
    words = "wait so long for a late command while the world stands still; no robot does"
    add("--patience", type=float, default=0.0, metavar="S", help=words)
    add_served(parser, ":\n" + describe(KINDS), default="real_drives")


def chosen(args: argparse.Namespace) -> dict[str, Any]:
    """The scenario's options; the arm is the one that speaks the protocol, if none is named."""
    return {"robot": ROBOT[args.protocol]} | options_of(args.set)


def check(args: argparse.Namespace) -> None:
    """Raises ValueError for an arm, a fault or a patience that does not exist."""
    if not 0.0 <= args.patience < float("inf"):
        raise ValueError(f"--patience takes seconds from 0 up, got {args.patience}")
    if not 0.0 <= args.object <= WIDEST:
        raise ValueError(f"--object takes 0 to {WIDEST} m, got {args.object}")
    check_scenario(args.scenario, chosen(args))
    for text in args.fault:
        read_fault(text, KINDS)
