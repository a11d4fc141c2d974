"""Requests and replies of the FCI's TCP channel: bytes to values and back. Pure."""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

from drivers.fci import tables
from drivers.fci.codec import JOINTS, WireError

HEADER = struct.Struct("<III")  # command, command id, size with header
LONGEST = 1 << 24  # bytes of a message; a robot model has about 10 kB
_CONNECT = struct.Struct("<HH")
_CONNECT_REPLY = struct.Struct("<BH")
# Translation, rotation and elbow deviation that every client sends; without use here.
_DEVIATION = (10.0, 3.12, 2.0 * math.pi)


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
    status, version = _CONNECT_REPLY.unpack_from(payload)
    return status, version


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
