"""Bytes of the FCI to values and back, both protocol versions. Pure.

Datagrams (UDP): packed, little-endian; Franka FCI documentation, libfranka 0.9.2 and 0.21.2
headers. Numbers of a state are f64 in protocol 5 and f32 in 10; those of a command are f64 in
both. Requests and replies (TCP): a header and a payload.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from drivers.fci import tables
from drivers.fci.tables import ERROR_COUNT
from drivers.interface import Array, DriverError

JOINTS = 7
MAX_ID: Final = 1 << 40  # ticks of 1 ms; no robot runs for 34 years
_ID = struct.Struct("<Q")
_COUNTS: tuple[tuple[str, int], ...] = (  # numbers of a state up to the accelerometers, in order
    ("O_T_EE", 16),
    ("O_T_EE_d", 16),
    ("F_T_EE", 16),
    ("EE_T_K", 16),
    ("F_T_NE", 16),
    ("NE_T_EE", 16),
    ("m_ee", 1),
    ("I_ee", 9),
    ("F_x_Cee", 3),
    ("m_load", 1),
    ("I_load", 9),
    ("F_x_Cload", 3),
    ("elbow", 2),
    ("elbow_d", 2),
    ("tau_J", 7),
    ("tau_J_d", 7),
    ("dtau_J", 7),
    ("q", 7),
    ("q_d", 7),
    ("dq", 7),
    ("dq_d", 7),
    ("ddq_d", 7),
    ("joint_contact", 7),
    ("cartesian_contact", 6),
    ("joint_collision", 7),
    ("cartesian_collision", 6),
    ("tau_ext_hat_filtered", 7),
    ("O_F_ext_hat_K", 6),
    ("K_F_ext_hat_K", 6),
    ("O_dP_EE_d", 6),
    ("O_ddP_O", 3),
    ("elbow_c", 2),
    ("delbow_c", 2),
    ("ddelbow_c", 2),
    ("O_T_EE_c", 16),
    ("O_dP_EE_c", 6),
    ("O_ddP_EE_c", 6),
    ("theta", 7),
    ("dtheta", 7),
)
_ACCELEROMETERS: tuple[tuple[str, int], ...] = (
    ("accelerometer_top", 18),
    ("accelerometer_bottom", 18),
)
_COMMAND_FIELDS: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = [
    ("message_id", "<u8"),
    ("q_c", "<f8", (7,)),
    ("dq_c", "<f8", (7,)),
    ("O_T_EE_c", "<f8", (16,)),
    ("O_dP_EE_c", "<f8", (6,)),
    ("elbow_c", "<f8", (2,)),
    ("valid_elbow", "u1"),
    ("motion_generation_finished", "u1"),
    ("tau_J_d", "<f8", (7,)),
]
COMMAND_DTYPE: dict[int, np.dtype[np.void]] = {
    tables.PANDA: np.dtype(_COMMAND_FIELDS),
    tables.FR3: np.dtype([*_COMMAND_FIELDS, ("torque_command_finished", "u1")]),
}
HEADER = struct.Struct("<III")  # command, command id, size with header
LONGEST = 1 << 24  # bytes of a message; a robot model has about 10 kB
_CONNECT = struct.Struct("<HH")
_CONNECT_REPLY = struct.Struct("<BH")
# Translation, rotation and elbow deviation that every client sends; without use here.
_DEVIATION = (10.0, 3.12, 2.0 * math.pi)


class WireError(DriverError):
    """Bytes that are no valid message of this protocol version; the message says why."""


def _state_dtype(number: str, counts: tuple[tuple[str, int], ...]) -> np.dtype[np.void]:
    fields: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = [("message_id", "<u8")]
    fields += [(name, number, (count,)) for name, count in counts]
    fields += [
        ("motion_generator_mode", "u1"),
        ("controller_mode", "u1"),
        ("errors", "u1", (ERROR_COUNT,)),
        ("reflex_reason", "u1", (ERROR_COUNT,)),
        ("robot_mode", "u1"),
        ("control_command_success_rate", number),
    ]
    return np.dtype(fields)


STATE_DTYPE: dict[int, np.dtype[np.void]] = {
    tables.PANDA: _state_dtype("<f8", _COUNTS),
    tables.FR3: _state_dtype("<f4", _COUNTS + _ACCELEROMETERS),
}


def _offset(dtype: np.dtype[np.void], name: str) -> int:
    assert dtype.fields is not None
    return dtype.fields[name][1]


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
        dtype = STATE_DTYPE[version]
        self.version, self.size = version, dtype.itemsize
        single = version == tables.FR3
        self._wire = np.dtype("<f4" if single else "<f8")
        self._numbers, self._load = _offset(dtype, "tau_J"), _offset(dtype, "m_load")
        self._count = (_offset(dtype, "dq_d") - self._numbers) // self._wire.itemsize
        self._status_from = _offset(dtype, "motion_generator_mode")
        self._status_to = _offset(dtype, "control_command_success_rate")
        self._rate = struct.Struct("<f" if single else "<d")
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
        if message_id > MAX_ID:
            raise WireError(f"a state with the absurd message id {message_id}")
        status_bytes = bytes(data[start + self._status_from : start + self._status_to])
        if status_bytes != self._last_bytes or self._last is None:
            self._last = _status(status_bytes, self.version)
            self._last_bytes = status_bytes
        wire = np.frombuffer(data, self._wire, self._count, start + self._numbers)
        numbers = wire.astype(np.float64)
        return State(
            message_id,
            numbers[21:28],
            numbers[35:42],
            numbers[0:7],
            numbers[7:14],
            self._last,
            self._rate.unpack_from(data, start + self._status_to)[0],
        )

    def accepted(self, data: memoryview, start: int) -> Array:
        """(7,) the torque command that the robot accepted last, N m, of the state at `start`."""
        at = start + self._numbers + JOINTS * self._wire.itemsize
        return np.frombuffer(data, self._wire, JOINTS, at).astype(np.float64)

    def load(self, data: memoryview, start: int) -> Array:
        """(13,) of the state at `start`: mass (kg), inertia (9,) and centre (3,) of the load."""
        return np.frombuffer(data, self._wire, 13, start + self._load).astype(np.float64)


def _status(data: bytes, version: int) -> Status:
    """Modes and errors from the 85 bytes that hold them. Raises WireError."""
    generator, controller, robot_mode = data[0], data[1], data[-1]
    errors, reflex = data[2 : 2 + ERROR_COUNT], data[2 + ERROR_COUNT : -1]
    for what, value, count in (
        ("motion generator mode", generator, tables.GENERATOR_MODES[version]),
        ("controller mode", controller, tables.CONTROLLER_MODES),
        ("robot mode", robot_mode, tables.ROBOT_MODES),
        ("error flag", max(max(errors), max(reflex)), 2),
    ):
        if value >= count:
            raise WireError(f"a state with the unknown {what} {value}; it ends at {count - 1}")
    return Status(generator, controller, errors, reflex, robot_mode)


class CommandEncoder:
    """Encodes torque commands of one protocol version into one buffer, used again and again."""

    def __init__(self, version: int) -> None:
        dtype = COMMAND_DTYPE[version]
        kind = "torque_command" if version == tables.FR3 else "motion_generation"
        self._buffer = bytearray(dtype.itemsize)
        self._torques = struct.Struct("<7d")
        self._at, self._finish = _offset(dtype, "tau_J_d"), _offset(dtype, f"{kind}_finished")

    def encode(self, message_id: int, tau: Sequence[float], finished: bool = False) -> bytearray:
        """The datagram that answers a state with 7 torques, N m; valid until the next call."""
        _ID.pack_into(self._buffer, 0, message_id)
        self._torques.pack_into(self._buffer, self._at, *tau)
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
            if not HEADER.size <= size <= LONGEST:
                raise WireError(f"an answer whose header says {size} bytes")
            if len(self._waiting) < size:
                break
            replies.append(Reply(command_id, bytes(self._waiting[HEADER.size : size])))
            del self._waiting[:size]
        return replies
