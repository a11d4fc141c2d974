"""Faults of simulated boards and their bus, and what else the boards can be asked for.

When faults strike, what they do; their seconds count from the first frame to a motor.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterable

import can

from sim.damiao import motor
from sim.damiao.bus import INTERFACES, MULTICAST_GROUP, MULTICAST_PORT
from sim.damiao.codec import BUS_ERROR, error_frame
from sim.faults import JOINT, SECONDS, SHARE, Faults, Kind, Network, Value, describe
from sim.options import add_served, options_of
from sim.options import check as check_scenario

OF_FRAMES = Value("a share of frames, from 0 to 1", SHARE.fits)
MOTOR = Value("the number of a motor, from 1 to 7", JOINT.fits)
KINDS = {
    "drop": Kind("a reply never arrives", OF_FRAMES),
    "deaf": Kind("a motor does not get a command", OF_FRAMES),
    "late": Kind("a reply comes 3 ms late", OF_FRAMES),
    "repeat": Kind("a reply comes twice", OF_FRAMES),
    "reorder": Kind("a reply comes after the next one", OF_FRAMES),
    "corrupt": Kind("a reply has one bit flipped or lost its last bytes", OF_FRAMES),
    "spike": Kind("a reply's angle is off by 0.5 rad", OF_FRAMES),
    "error_frames": Kind("the bus carries an error frame besides a reply", OF_FRAMES),
    "silent": Kind("the motor answers nothing", MOTOR, "1"),
    "stuck": Kind("its encoder stands still", MOTOR, "1"),
    "jump": Kind("its encoder jumps by 0.1 rad and stays there", MOTOR, "1"),
    "overtemp": Kind("its rotor gets too hot", MOTOR, "1"),
    "undervoltage": Kind("its supply is too low", MOTOR, "1"),
    "overvoltage": Kind("its supply is too high", MOTOR, "1"),
    "overcurrent": Kind("its current is too high", MOTOR, "1"),
    "overload": Kind("it reports overload", MOTOR, "1"),
    "bus_off": Kind("the bus is dead for so long", SECONDS, "1"),
}
# What strikes the host's own controller, on a line or a wrapped bus, and not the boards.
OF_HOSTS = {"enobufs": Kind("the host's controller refuses to send", OF_FRAMES)}
NAMES = (*KINDS, *OF_HOSTS)
STATUS = {
    "undervoltage": motor.UNDER_VOLTAGE,
    "overvoltage": motor.OVER_VOLTAGE,
    "overcurrent": motor.OVER_CURRENT,
    "overload": motor.OVERLOAD,
}
SPIKE_RAD, JUMP_RAD, LATE_NS = 0.5, 0.1, 3_000_000
HOT_C = 130.0


def board_faults(texts: Iterable[str] = (), seed: int = 0) -> Faults:
    """Faults of the boards, and of a host's controller. Raises ValueError, naming the choices."""
    return Faults(texts, KINDS | OF_HOSTS, (seed, 1 << 33))  # apart from truth and noise


class Outbox:
    """Sends replies, now or later.

    Attributes:
        sent: frames that went out, error frames not counted.
        failed: frames that the bus would not take.
    """

    def __init__(self, bus: can.BusABC, faults: Faults) -> None:
        self._bus, self._faults = bus, faults
        self._network = Network(faults, lambda: LATE_NS, self._damaged)
        self.next_ns = self._network.next_due
        self.sent = self.failed = 0

    def put(self, message: can.Message, now_ns: int, now_s: float) -> None:
        """Send a reply, as far as the faults allow."""
        if self._faults and self._faults.strikes("error_frames", now_s):
            self.tell(error_frame(BUS_ERROR))
        for arrives in self._network.passed(message, now_s, now_ns):
            self._send(arrives)

    def tell(self, message: can.Message) -> None:
        """Put something on the bus that is no reply."""
        with contextlib.suppress(can.CanError):
            self._bus.send(message)

    def flush(self, now_ns: int) -> None:
        """Send what is due by now."""
        for message in self._network.due(now_ns):
            self._send(message)

    def _send(self, message: can.Message) -> None:
        try:
            self._bus.send(message)
            self.sent += 1
        except can.CanError:
            self.failed += 1

    def _damaged(self, message: can.Message) -> can.Message:
        size, pick = len(message.data), self._faults.pick
        if pick(2):
            message.data[pick(size)] ^= 1 << pick(8)
        else:
            del message.data[pick(size) :]
            message.dlc = len(message.data)
        return message


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
    add("--motors", choices=tuple(motor.SETS), default="panda", help="default panda")
    faults = ", seconds from the first frame on:\n" + describe(KINDS)
    of_set = "as in noise=real: a Panda's sensor noise beside the quantisation"
    add_served(parser, faults, of_set)


def check(args: argparse.Namespace) -> None:
    """Raises ValueError for an arm or a fault that does not exist, or is no board's."""
    check_scenario(args.scenario, options_of(args.set))
    for fault in board_faults(args.fault).faults:
        if fault.name in OF_HOSTS:
            raise ValueError(f"fault {fault.name} strikes a host's own controller, not the boards")
