"""What the simulated robot can be asked for; its faults, and what they do.

Faults change measured values, datagrams or the robot itself.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim.faults import (
    COUNT,
    JOINT,
    NAME,
    NOTHING,
    SECONDS,
    VERSION,
    Fault,
    Kind,
    describe,
    read_fault,
)
from sim.fci.codec import ERRORS, HOST, JOINTS, PORT, TICK_S, VERSIONS, StateFrame
from sim.fci.gripper import WIDEST
from sim.options import add_served, options_of
from sim.options import check as check_scenario

KINDS = {
    "drop": Kind("states are lost"),
    "drop_commands": Kind("commands are lost"),
    "late": Kind("states arrive 1 to 5 ms later"),
    "repeat": Kind("states arrive twice"),
    "reorder": Kind("states arrive after their successor"),
    "corrupt": Kind("states arrive with some bytes changed, or cut short"),
    "nan": Kind("a joint's q, dq or torque is not a number"),
    "spike": Kind("a joint's q, dq or torque is far off for a tick"),
    "stuck": Kind("a joint's q stays what it was", JOINT, "3"),
    "jump": Kind("a joint's q is 0.05 rad more from then on", JOINT, "3"),
    "reflex": Kind("the robot trips with this error", NAME, "cartesian_reflex", tuple(ERRORS)),
    "user_stop": Kind("somebody presses the user stop for so long", SECONDS, "1"),
    "cut": Kind("the connection is closed", NOTHING),
    "silence": Kind("nothing is sent for so long", SECONDS, "1000000"),
    "clock": Kind("message ids jump by so many", COUNT, "10000"),
    "version": Kind("the server says that it speaks this version", VERSION, "7", timed=False),
}
SPIKES = {"q": 0.5, "dq": 2.0, "tau_J": 20.0}  # rad, rad/s, N m
JUMP_RAD = 0.05
OF_DATAGRAMS = ("drop", "late", "repeat", "reorder", "corrupt")
ROBOT = {5: "panda", 10: "fr3"}  # by protocol
AT_A_TIME = ("reflex", "user_stop", "cut", "silence", "clock")


class Spoiler:
    """The faults of one server, with a random source of its own.

    Attributes:
        counts: how often each fault has acted.
    """

    def __init__(self, faults: Sequence[Fault], seed: int) -> None:
        self._rng = np.random.default_rng([seed, 1337])
        self._lasting = [fault for fault in faults if fault.name not in (*AT_A_TIME, "version")]
        self._waiting = [fault for fault in faults if fault.name in AT_A_TIME]
        self.counts: dict[str, int] = {fault.name: 0 for fault in faults}
        self._frozen: dict[int, float] = {}
        self._later: list[tuple[int, bytes]] = []
        self._held: bytes | None = None

    def due(self, tick: int) -> list[Fault]:
        """The faults that happen once and whose time has come."""
        due = [fault for fault in self._waiting if fault.at_s <= tick * TICK_S]
        for fault in due:
            self._waiting.remove(fault)
            self.counts[fault.name] += 1
        return due

    def spoil_values(self, frame: StateFrame, tick: int) -> None:
        """Change measured values in a state, as a broken sensor would."""
        for fault in self._lasting:
            if fault.at_s > tick * TICK_S:
                continue
            if fault.name in ("stuck", "jump"):
                at, q = int(fault.value) - 1, frame.fields["q"]
                if not self.counts[fault.name]:
                    self.counts[fault.name] = 1
                    self._frozen[at] = float(q[at])
                for reading in (q, frame.fields["theta"]):
                    jumped = reading[at] + JUMP_RAD
                    reading[at] = jumped if fault.name == "jump" else self._frozen[at]
            elif fault.name in ("nan", "spike") and self._happens(fault):
                name = ("q", "dq", "tau_J")[self._rng.integers(3)]
                joint = self._rng.integers(JOINTS)
                if fault.name == "nan":
                    frame.fields[name][joint] = np.nan
                else:
                    frame.fields[name][joint] += SPIKES[name] * self._rng.choice((-1.0, 1.0))

    def loses_command(self, tick: int) -> bool:
        """Whether the network loses the command of this tick."""
        return any(
            fault.name == "drop_commands" and fault.at_s <= tick * TICK_S and self._happens(fault)
            for fault in self._lasting
        )

    def deliver(self, state: bytearray, tick: int) -> Sequence[bytes | bytearray]:
        """The datagrams that leave in this tick for this state and those held back before."""
        if not self._lasting:
            return (state,)
        out: list[bytes] = [data for when, data in self._later if when <= tick]
        self._later = [item for item in self._later if item[0] > tick]
        held, self._held = self._held, None
        out.extend(self._pass_on(bytes(state), tick))
        if held is not None:
            out.append(held)
        return out

    def forget(self) -> None:
        """The connection is gone, and with it whatever was under way."""
        self._later, self._held = [], None

    def _pass_on(self, data: bytes, tick: int) -> list[bytes]:
        """One datagram through the network."""
        copies = [data]
        for fault in self._lasting:
            waits = fault.at_s > tick * TICK_S or fault.name not in OF_DATAGRAMS
            if waits or not copies or not self._happens(fault):
                continue
            if fault.name == "repeat":
                copies = copies * 2
            elif fault.name == "corrupt":
                copies = [self._corrupt(item) for item in copies]
            elif fault.name == "reorder":
                self._held, copies = copies[0], []
            else:
                if fault.name == "late":
                    when = tick + int(self._rng.integers(1, 6))
                    self._later.extend((when, item) for item in copies)
                copies = []
        return copies

    def _corrupt(self, data: bytes) -> bytes:
        if self._rng.random() < 0.5:
            return data[: self._rng.integers(len(data))]
        changed = bytearray(data)
        for at in self._rng.integers(len(data), size=self._rng.integers(1, 9)):
            changed[at] ^= int(self._rng.integers(1, 256))
        return bytes(changed)

    def _happens(self, fault: Fault) -> bool:
        hit = bool(self._rng.random() < fault.value)
        self.counts[fault.name] += hit
        return hit


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
