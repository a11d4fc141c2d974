"""What the simulated arm can be asked for; light, so that wrong use is told at once."""

from __future__ import annotations

import argparse
import os

from sim.faults import NOTHING, Kind, describe, read_fault
from sim.options import add_served, options_of
from sim.options import check as check_scenario

DOMAIN, STATES, COMMANDS = "0", "/joint_states", "/effort_controller/commands"
KINDS = {
    "silence": Kind("no joint states from then on", NOTHING),
    "nan": Kind("share of joint states with a position that is none"),
    "jump": Kind("share of joint states with a joint 0.5 rad off"),
    "moved": Kind("every position is 0.5 rad off from then on", NOTHING),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    domain = int(os.environ.get("ROS_DOMAIN_ID") or DOMAIN)
    add("--domain", type=int, default=domain, metavar="N", help="of DDS; ROS_DOMAIN_ID, else 0")
    add("--states", default=STATES, metavar="TOPIC", help=f"of the joint states, {STATES}")
    add("--commands", default=COMMANDS, metavar="TOPIC", help=f"of the torques, {COMMANDS}")
    words = "joint states come every N ms, default 1"
    add("--every", type=int, choices=(1, 2, 4, 5, 10, 20), default=1, metavar="N", help=words)
    words = "the drives brake when no command is new for so long; 0 never, as without a watch"
    add("--watch", type=float, default=0.1, metavar="S", help=words)
    add("--no-description", action="store_true", help="nobody publishes /robot_description")
    add_served(parser, ", from the first command on:\n" + describe(KINDS))


def check(args: argparse.Namespace) -> None:
    """Raises ValueError for an arm, a fault or a watch that does not exist."""
    if not 0.0 <= args.watch < float("inf"):
        raise ValueError(f"--watch takes seconds from 0 up, got {args.watch}")
    check_scenario(args.scenario, options_of(args.set))
    for text in args.fault:
        read_fault(text, KINDS)
