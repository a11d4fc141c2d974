"""A plain python-can client of Damiao motors, and simulated boards beside it."""

from __future__ import annotations

import socket
import struct
from contextlib import contextmanager
from dataclasses import dataclass

import can

from sim.damiao.faults import board_faults
from sim.damiao.server import BoardOptions, Boards
from sim.scenarios import build
from tests.helpers.can_line import Line

MS_NS = 1_000_000
IDS = range(1, 8)
ENABLE, DISABLE, CLEAR, ZERO = (bytes([0xFF] * 7 + [last]) for last in (0xFC, 0xFD, 0xFB, 0xFE))
NOTHING = bytes.fromhex("7FFF7FF0000007FF")  # all zero command of the reference page
PANDA = ((12.5, 25.0, 100.0),) * 4 + ((12.5, 45.0, 12.5),) * 3
STATUS_OF = {"undervoltage": 9, "overvoltage": 8, "overcurrent": 0xA, "overload": 0xE}


@dataclass(frozen=True)
class Feedback:
    motor: int
    status: int
    q: float
    dq: float
    tau: float
    mosfet: int
    rotor: int
    stamp_s: float


def frame(identifier: int, data: bytes, fd: bool = True) -> can.Message:
    return can.Message(
        arbitration_id=identifier, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd
    )


def refresh(motor: int) -> bytes:
    return bytes([motor, 0, 0xCC, 0, 0, 0, 0, 0])


def read_register(motor: int, register: int) -> bytes:
    return bytes([motor, 0, 0x33, register, 0, 0, 0, 0])


def write_register(motor: int, register: int, value: float | int) -> bytes:
    packed = struct.pack("<I" if isinstance(value, int) else "<f", value)
    return bytes([motor, 0, 0x55, register]) + packed


def mit(scale, q=0.0, dq=0.0, kp=0.0, kd=0.0, tau=0.0) -> bytes:
    """A MIT command, nearest codes."""
    pmax, vmax, tmax = scale
    codes = [
        (round((q + pmax) / (2 * pmax) * 65535), 16),
        (round((dq + vmax) / (2 * vmax) * 4095), 12),
        (round(kp / 500 * 4095), 12),
        (round(kd / 5 * 4095), 12),
        (round((tau + tmax) / (2 * tmax) * 4095), 12),
    ]
    bits = "".join(f"{min(max(code, 0), 2**width - 1):0{width}b}" for code, width in codes)
    return int(bits, 2).to_bytes(8, "big")


def parse(message: can.Message, scale) -> Feedback:
    d, (pmax, vmax, tmax) = message.data, scale
    q, dq, tau = d[1] << 8 | d[2], d[3] << 4 | d[4] >> 4, (d[4] & 15) << 8 | d[5]
    return Feedback(
        d[0] & 15,
        d[0] >> 4,
        -pmax + q / 65535 * 2 * pmax,
        -vmax + dq / 4095 * 2 * vmax,
        -tmax + tau / 4095 * 2 * tmax,
        d[6],
        d[7],
        message.timestamp,
    )


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
        self.line.host.send(frame(identifier, data, self.fd))

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

    def state(self, motor: int) -> Feedback:
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
