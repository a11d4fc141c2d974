"""What the simulated boards can be asked for; light, so that wrong use is told at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from sim.damiao.bus import INTERFACES, MULTICAST_GROUP, MULTICAST_PORT
from sim.damiao.faults import KINDS, OF_HOSTS
from sim.damiao.motor import SETS
from sim.faults import describe, read_fault
from sim.options import add_scenario, options_of
from sim.options import check as check_scenario


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "faults, NAME[=VALUE][@SECONDS], seconds from the first frame on:\n" + describe(
        KINDS
    )
    parser.add_argument(
        "--interface", choices=INTERFACES, default=INTERFACES[0], help=f"default {INTERFACES[0]}"
    )
    parser.add_argument(
        "--channel",
        default=MULTICAST_GROUP,
        metavar="WHERE",
        help=f"multicast group (default {MULTICAST_GROUP}) or CAN interface, as in vcan0",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=MULTICAST_PORT,
        help=f"of the multicast group, default {MULTICAST_PORT}",
    )
    parser.add_argument("--fd", type=int, choices=(0, 1), default=1, help="CAN FD, default 1")
    parser.add_argument("--motors", choices=tuple(SETS), default="panda", help="default panda")
    add_scenario(parser, "as in noise=real: a Panda's sensor noise beside the quantisation")
    parser.add_argument(
        "--fault", action="append", default=[], metavar="FAULT", help="see below; repeatable"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="end after so many seconds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")


def check(args: argparse.Namespace) -> None:
    """Raises ValueError for an arm or a fault that does not exist, or is no board's."""
    check_scenario(args.scenario, options_of(args.set))
    for text in args.fault:
        if read_fault(text, KINDS | OF_HOSTS).name in OF_HOSTS:
            raise ValueError(f"fault {text!r} strikes a host's own controller, not the boards")
