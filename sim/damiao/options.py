"""What the simulated boards can be asked for; light, so that wrong use is told at once."""

from __future__ import annotations

import argparse

from sim.damiao.bus import INTERFACES, MULTICAST_GROUP, MULTICAST_PORT
from sim.damiao.faults import KINDS, OF_HOSTS
from sim.damiao.motor import SETS
from sim.faults import describe, read_fault
from sim.options import add_served, options_of
from sim.options import check as check_scenario


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    words = f"default {INTERFACES[0]}"
    add("--interface", choices=INTERFACES, default=INTERFACES[0], help=words)
    words = f"multicast group (default {MULTICAST_GROUP}) or CAN interface, as in vcan0"
    add("--channel", default=MULTICAST_GROUP, metavar="WHERE", help=words)
    words = f"of the multicast group, default {MULTICAST_PORT}"
    add("--port", type=int, default=MULTICAST_PORT, help=words)
    add("--fd", type=int, choices=(0, 1), default=1, help="CAN FD, default 1")
    add("--motors", choices=tuple(SETS), default="panda", help="default panda")
    faults = ", seconds from the first frame on:\n" + describe(KINDS)
    of_set = "as in noise=real: a Panda's sensor noise beside the quantisation"
    add_served(parser, faults, of_set)


def check(args: argparse.Namespace) -> None:
    """Raises ValueError for an arm or a fault that does not exist, or is no board's."""
    check_scenario(args.scenario, options_of(args.set))
    for text in args.fault:
        if read_fault(text, KINDS | OF_HOSTS).name in OF_HOSTS:
            raise ValueError(f"fault {text!r} strikes a host's own controller, not the boards")
