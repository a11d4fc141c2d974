"""Bytes of the FCI to values and back, both protocol versions. Pure.

Datagrams (UDP): packed, little-endian; Franka FCI documentation, libfranka 0.9.2 and 0.21.2
headers. Numbers of a state are f64 in protocol 5 and f32 in 10; those of a command are f64 in
both. Requests and replies (TCP): a header and a payload.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drivers.fci import tables
from drivers.fci.tables import ERROR_COUNT
from drivers.interface import Array, DriverError

JOINTS = 7
_ID = struct.Struct("<Q")


class _Places(NamedTuple):
    """Where lies what the driver uses: in a state from `load` to `size`, in a command the rest.

    A state's numbers are of one type. At `load` are mass, inertia (9) and centre (3) of the load;
    from `torques` on tau_J, tau_J_d, dtau_J, q, q_d and dq, seven each; from `modes` on the bytes
    of motion generator, controller, errors, reflex reasons and robot mode. A command's torques are
    the last numbers of it.
    """

    wire: np.dtype[np.floating]
    load: int
    torques: int
    modes: int
    rate: int
    size: int
    finished: int
    command_size: int


_PLACES = {
    tables.PANDA: _Places(np.dtype("<f8"), 880, 1016, 2280, 2365, 2373, 313, 370),
    tables.FR3: _Places(np.dtype("<f4"), 444, 512, 1288, 1373, 1377, 370, 371),
}
_COMMAND_TORQUES = 314
HEADER = struct.Struct("<III")  # command, command id, size with header
_CONNECT = struct.Struct("<HH")
_CONNECT_REPLY = struct.Struct("<BH")
# Translation, rotation and elbow deviation that every client sends; without use here.
_DEVIATION = (10.0, 3.12, 2.0 * math.pi)


class WireError(DriverError):
    """Bytes that are no valid message of this protocol version; the message says why."""


def id_at(data: memoryview, start: int) -> int:
    """Message id of the state that begins there."""
    return _ID.unpack_from(data, start)[0]


class Status(NamedTuple):
    """Modes and errors of a state; the same object as long as none of them changes."""

    generator: int
    controller: int
    errors: bytes
    reflex_reason: bytes
    robot_mode: int


class State(NamedTuple):
    """What the driver uses of one state.

    Attributes:
        message_id: ticks of 1 ms since the robot's start.
        q, dq: (7,) rad, rad/s.
        tau_J: (7,) link-side torques, gravity included, N m.
        tau_J_d: (7,) the torque command that the robot accepted last, N m.
        status: modes and errors.
        success_rate: share of the last 100 commands that arrived.
    """

    message_id: int
    q: Array
    dq: Array
    tau_J: Array
    tau_J_d: Array
    status: Status
    success_rate: float


class StateDecoder:
    """Decodes states of one protocol version.

    The numbers in use (tau_J to dq) lie side by side and become float64 by one copy; modes and
    errors are looked at only where their bytes differ from those of the last state.

    Attributes:
        size: of a state, bytes.
    """

    def __init__(self, version: int) -> None:
        self.version, self._at = version, _PLACES[version]
        self.size, self._wire = self._at.size, self._at.wire
        self._rate = struct.Struct("<f" if version == tables.FR3 else "<d")
        self._last_bytes: bytes | None = None
        self._last: Status | None = None

    def decode(self, data: memoryview, start: int = 0, length: int | None = None) -> State:
        """The state at `data[start:start + length]`; up to the end of data without a length.

        Numbers may be anything, not finite ones included: judging a sensor is not the wire's
        business. Raises WireError for a wrong size, an absurd id, an unknown mode or flag.
        """
        length = len(data) - start if length is None else length
        if length != self.size or len(data) - start < length:
            raise WireError(
                f"a state of {length} bytes; protocol {self.version} has {self.size} bytes"
            )
        message_id = id_at(data, start)
        if message_id > 1 << 40:  # ms: no robot runs for 34 years
            raise WireError(f"a state with the absurd message id {message_id}")
        status_bytes = bytes(data[start + self._at.modes : start + self._at.rate])
        if status_bytes != self._last_bytes or self._last is None:
            # Modes and errors from the 85 bytes that hold them
            generator, controller, robot_mode = status_bytes[0], status_bytes[1], status_bytes[-1]
            errors, reflex = status_bytes[2 : 2 + ERROR_COUNT], status_bytes[2 + ERROR_COUNT : -1]
            for what, value, count in (
                ("motion generator mode", generator, tables.GENERATOR_MODES[self.version]),
                ("controller mode", controller, tables.CONTROLLER_MODES),
                ("robot mode", robot_mode, tables.ROBOT_MODES),
                ("error flag", max(max(errors), max(reflex)), 2),
            ):
                if value >= count:
                    raise WireError(
                        f"a state with the unknown {what} {value}; it ends at {count - 1}"
                    )
            self._last = Status(generator, controller, errors, reflex, robot_mode)
            self._last_bytes = status_bytes
        wire = np.frombuffer(data, self._wire, 6 * JOINTS, start + self._at.torques)
        numbers = wire.astype(np.float64)
        return State(
            message_id,
            numbers[21:28],
            numbers[35:42],
            numbers[0:7],
            numbers[7:14],
            self._last,
            self._rate.unpack_from(data, start + self._at.rate)[0],
        )

    def accepted(self, data: memoryview, start: int) -> Array:
        """(7,) the torque command that the robot accepted last, N m, of the state at `start`."""
        at = start + self._at.torques + JOINTS * self._wire.itemsize
        return np.frombuffer(data, self._wire, JOINTS, at).astype(np.float64)

    def load(self, data: memoryview, start: int) -> Array:
        """(13,) of the state at `start`: mass (kg), inertia (9,) and centre (3,) of the load."""
        return np.frombuffer(data, self._wire, 13, start + self._at.load).astype(np.float64)


class CommandEncoder:
    """Encodes torque commands of one protocol version into one buffer, used again and again."""

    def __init__(self, version: int) -> None:
        self._buffer = bytearray(_PLACES[version].command_size)
        self._torques, self._finish = struct.Struct("<7d"), _PLACES[version].finished

    def encode(self, message_id: int, tau: Sequence[float], finished: bool = False) -> bytearray:
        """The datagram that answers a state with 7 torques, N m; valid until the next call."""
        _ID.pack_into(self._buffer, 0, message_id)
        self._torques.pack_into(self._buffer, _COMMAND_TORQUES, *tau)
        self._buffer[self._finish] = finished
        return self._buffer


class Reply(NamedTuple):
    """One reply: the id of the request it belongs to, and what follows the header."""

    command_id: int
    payload: bytes


def request(command: int, command_id: int, payload: bytes = b"") -> bytes:
    """A request, header included."""
    return HEADER.pack(command, command_id, HEADER.size + len(payload)) + payload


def connect_payload(version: int, udp_port: int) -> bytes:
    """Of Connect: our protocol version and the port on which we want states."""
    return _CONNECT.pack(version, udp_port)


def move_payload(version: int) -> bytes:
    """Of Move: pure torque control, with zero velocities in protocol 5."""
    modes = struct.pack("<II", tables.CONTROLLER_TORQUE, tables.MOVE_GENERATOR[version])
    deviations = struct.pack("<6d", *_DEVIATION, *_DEVIATION)
    tail = struct.pack(f"<B{JOINTS}d", 0, *[0.0] * JOINTS) if version == tables.FR3 else b""
    return modes + deviations + tail


def connect_reply(payload: bytes) -> tuple[int, int]:
    """(status, the robot's protocol version). Raises WireError for a reply cut short."""
    if len(payload) < _CONNECT_REPLY.size:
        raise WireError(
            f"an answer to Connect of {HEADER.size + len(payload)} bytes; it has "
            f"{HEADER.size + _CONNECT_REPLY.size}"
        )
    return _CONNECT_REPLY.unpack_from(payload)


def status_reply(payload: bytes) -> int:
    """Status of any other reply. Raises WireError for a reply without one."""
    if not payload:
        raise WireError("an answer without a status byte")
    return payload[0]


class ReplyParser:
    """Cuts the byte stream of the robot into replies, however it is delivered."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def feed(self, data: bytes) -> list[Reply]:
        """The replies that these bytes complete. Raises WireError for an impossible length."""
        self._waiting += data
        replies = []
        while len(self._waiting) >= HEADER.size:
            _, command_id, size = HEADER.unpack_from(self._waiting)
            if not HEADER.size <= size <= 1 << 24:  # bytes; a robot model has about 10 kB
                raise WireError(f"an answer whose header says {size} bytes")
            if len(self._waiting) < size:
                break
            replies.append(Reply(command_id, bytes(self._waiting[HEADER.size : size])))
            del self._waiting[:size]
        return replies
