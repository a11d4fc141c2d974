"""A client of Damiao motors, with the driver's codec, and simulated boards beside it."""

from __future__ import annotations

import socket
from contextlib import contextmanager
from functools import partial

import can

from drivers.damiao.codec import ENABLE, Scales, State, mit_command, refresh, state
from sim.damiao.codec import data_frame
from sim.damiao.faults import board_faults
from sim.damiao.server import BoardOptions, Boards
from sim.scenarios import build
from tests.helpers.can_line import Line

MS_NS = 1_000_000
IDS = range(1, 8)
ZERO = bytes([0xFF] * 7 + [0xFE])
NOTHING = bytes.fromhex("7FFF7FF0000007FF")  # all zero command of the reference page
PANDA = ((12.5, 25.0, 100.0),) * 4 + ((12.5, 45.0, 12.5),) * 3
STATUS_OF = {"undervoltage": 9, "overvoltage": 8, "overcurrent": 0xA, "overload": 0xE}
frame = partial(data_frame, fd=True)


def mit(scale, q=0.0, dq=0.0, kp=0.0, kd=0.0, tau=0.0) -> bytes:
    """A MIT command to a motor of this scale."""
    return mit_command(Scales(*scale), q, dq, kp, kd, tau)


def parse(message: can.Message, scale) -> State:
    return state(Scales(*scale), message.data)


class Rig:
    """Boards on a line in virtual time, with a client at the other end."""

    def __init__(self, scenario="nominal", faults=(), seed=0, fd=True, **more) -> None:
        self.scenario = build(scenario, seed) if isinstance(scenario, str) else scenario
        self.faults = board_faults(faults, seed)
        self.line = Line(fd=fd, faults=self.faults)
        self.fd, self.scale = fd, more.pop("scale", PANDA)
        self.boards = Boards(
            self.line.boards, self.scenario, BoardOptions(**more), self.faults, self.line.now_ns
        )  # fmt: skip
        self.line.attach(self.boards)

    def close(self) -> None:
        self.boards.close()
        self.line.host.shutdown()
        self.line.boards.shutdown()

    def send(self, identifier: int, data: bytes) -> None:
        self.line.host.send(data_frame(identifier, data, self.fd))

    def pass_ms(self, ms: float = 1.0) -> None:
        """Let time pass in one go."""
        self.line.advance_to(self.line.now_ns() + round(ms * MS_NS))

    def messages(self) -> list[can.Message]:
        found = []
        while (message := self.line.host.recv(0.0)) is not None:
            found.append(message)
        return found

    def ask(self, identifier: int, data: bytes) -> list[can.Message]:
        self.send(identifier, data)
        self.pass_ms(0.3)
        return self.messages()

    def state(self, motor: int) -> State:
        (message,) = self.ask(0x7FF, refresh(motor))
        return parse(message, self.scale[motor - 1])

    def enable(self) -> None:
        for motor in IDS:
            self.send(motor, ENABLE)
        self.pass_ms(1.0)
        self.messages()

    def tick(self, commands) -> list[can.Message]:
        """One command to each motor at the start of a millisecond; what came back in it."""
        for motor, data in zip(IDS, commands, strict=True):
            self.send(motor, data)
        self.pass_ms(1.0)
        return self.messages()

    def hold(self, q, kp=300.0, kd=5.0, tau=(0.0,) * 7) -> list[bytes]:
        return [
            mit(self.scale[j], q=float(q[j]), kp=kp, kd=kd, tau=float(tau[j])) for j in range(7)
        ]


@contextmanager
def rig(*args, **more):
    opened = Rig(*args, **more)
    try:
        yield opened
    finally:
        opened.close()


@contextmanager
def two_buses(channel: str):
    """Both ends of a virtual bus."""
    with (
        can.Bus(interface="virtual", channel=channel) as near,
        can.Bus(interface="virtual", channel=channel) as far,
    ):
        yield near, far


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return probe.getsockname()[1]
