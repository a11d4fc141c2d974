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
    Faults,
    Kind,
    Network,
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
AT_A_TIME = ("reflex", "user_stop", "cut", "silence", "clock")


class Spoiler(Faults):
    """The faults of one server."""

    def __init__(self, texts: Sequence[str], seed: int) -> None:
        super().__init__(texts, KINDS, (seed, 1337))
        self.counts.update(dict.fromkeys((fault.name for fault in self.faults), 0))
        self._frozen: dict[int, float] = {}
        self.network = Network[bytes](self, lambda: 1 + self.pick(5), self._damaged)

    def spoil_values(self, frame: StateFrame, now_s: float) -> None:
        """Change measured values in a state, as a broken sensor would."""
        fields, q = frame.fields, frame.fields["q"]
        for name in ("stuck", "jump"):
            for fault in self.acting(name, now_s):
                at, self.counts[name] = int(fault.value) - 1, 1
                frozen = self._frozen.setdefault(at, float(q[at]))
                for reading in (q, fields["theta"]):
                    reading[at] = frozen if name == "stuck" else reading[at] + JUMP_RAD
        for name in ("nan", "spike"):
            if self.strikes(name, now_s):
                key, joint = tuple(SPIKES)[self.pick(len(SPIKES))], self.pick(JOINTS)
                off = SPIKES[key] * (1.0 if self.pick(2) else -1.0)
                fields[key][joint] = np.nan if name == "nan" else fields[key][joint] + off

    def deliver(self, state: bytearray, tick: int) -> Sequence[bytes | bytearray]:
        """The datagrams that leave in this tick for this state and those held back before."""
        if not self:
            return (state,)
        passed = self.network.passed(bytes(state), tick * TICK_S, tick)
        return [*self.network.due(tick), *passed]

    def _damaged(self, data: bytes) -> bytes:
        if self.pick(2):
            return data[: self.pick(len(data))]
        changed = bytearray(data)
        for _ in range(1 + self.pick(8)):
            changed[self.pick(len(data))] ^= 1 + self.pick(255)
        return bytes(changed)


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
    return {"robot": {5: "panda", 10: "fr3"}[args.protocol]} | options_of(args.set)


def check(args: argparse.Namespace) -> None:
    """Raises ValueError for an arm, a fault or a patience that does not exist."""
    if not 0.0 <= args.patience < float("inf"):
        raise ValueError(f"--patience takes seconds from 0 up, got {args.patience}")
    if not 0.0 <= args.object <= WIDEST:
        raise ValueError(f"--object takes 0 to {WIDEST} m, got {args.object}")
    check_scenario(args.scenario, chosen(args))
    for text in args.fault:
        read_fault(text, KINDS)
