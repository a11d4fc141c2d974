"""Requests over TCP and the replies to them, as bytes."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from sim.fci.statuses import code_of
from sim.truth import Array

HEADER = struct.Struct("<III")  # command, command id, size with this header
LONGEST = 428  # bytes, SetCollisionBehavior
_CONNECT = struct.Struct("<HH")  # version, UDP port of the client

NAMES = {
    5: (
        "Connect", "Move", "StopMove", "GetCartesianLimit", "SetCollisionBehavior",
        "SetJointImpedance", "SetCartesianImpedance", "SetGuidingMode", "SetEEToK", "SetNEToEE",
        "SetLoad", "SetFilters", "AutomaticErrorRecovery", "LoadModelLibrary",
    ),
    10: (
        "Connect", "Move", "StopMove", "SetCollisionBehavior", "SetJointImpedance",
        "SetCartesianImpedance", "SetGuidingMode", "SetEEToK", "SetNEToEE", "SetLoad",
        "AutomaticErrorRecovery", "GetRobotModel",
    ),
}  # fmt: skip
# Bytes of a request after its header; Move has another size in version 10.
SIZES = {
    "Connect": 4, "Move": 56, "StopMove": 0, "GetCartesianLimit": 4, "SetCollisionBehavior": 416,
    "SetJointImpedance": 56, "SetCartesianImpedance": 48, "SetGuidingMode": 7, "SetEEToK": 128,
    "SetNEToEE": 128, "SetLoad": 104, "SetFilters": 40, "AutomaticErrorRecovery": 0,
    "LoadModelLibrary": 2, "GetRobotModel": 0,
}  # fmt: skip
MOVE_BYTES_10 = 113
_LIMIT_REPLY = 153  # bytes of GetCartesianLimit's reply between status and its last byte, with it


@dataclass(frozen=True, slots=True)
class Request:
    """One request of a client.

    Attributes:
        name: what it asks for.
        number: its number on the wire.
        ident: the client's counter, to be repeated in the reply.
        payload: what follows the header.
    """

    name: str
    number: int
    ident: int
    payload: bytes

    def numbers(self) -> Array:
        """The payload as f64 (k,), for the requests that hold nothing else."""
        return np.frombuffer(self.payload, "<f8").astype(float)

    def move_modes(self) -> tuple[int, int]:
        """Controller and generator mode that a Move asks for."""
        controller, generator = struct.unpack_from("<II", self.payload)
        return int(controller), int(generator)

    def connect_terms(self) -> tuple[int, int]:
        """Version and UDP port of a Connect."""
        version, port = _CONNECT.unpack(self.payload)
        return int(version), int(port)


class BadRequest(ValueError):
    """Bytes that are no request of this protocol; the connection cannot go on."""


class RequestReader:
    """Cuts a TCP stream into requests."""

    def __init__(self, version: int) -> None:
        self._version, self._held = version, bytearray()

    def feed(self, data: bytes) -> list[Request]:
        """The requests that are complete with `data`. Raises BadRequest."""
        self._held += data
        found = []
        while len(self._held) >= HEADER.size:
            number, ident, size = HEADER.unpack_from(self._held)
            name = self._name(number, size)
            if len(self._held) < size:
                break
            found.append(Request(name, number, ident, bytes(self._held[HEADER.size : size])))
            del self._held[:size]
        return found

    def _name(self, number: int, size: int) -> str:
        names = NAMES[self._version]
        if number >= len(names):
            raise BadRequest(f"no command {number} in protocol {self._version}")
        name = names[number]
        payload = MOVE_BYTES_10 if name == "Move" and self._version == 10 else SIZES[name]
        # A client of another version learns of it from the reply to Connect, which is alike in all.
        if size != HEADER.size + payload:
            raise BadRequest(f"{name} of {size} bytes; has: {HEADER.size + payload}")
        return name


def reply(request: Request, status: str, version: int, rest: bytes = b"") -> bytes:
    """A reply: header, status byte, and whatever this request's reply has besides."""
    code = code_of(request.name, status, version)
    size = HEADER.size + 1 + len(rest)
    return HEADER.pack(request.number, request.ident, size) + bytes((code,)) + rest


def connect_reply(request: Request, status: str, version: int, said_version: int) -> bytes:
    """The reply to Connect; `said_version` is what the server calls itself."""
    return reply(request, status, version, struct.pack("<H", said_version))


def limit_reply(request: Request, version: int) -> bytes:
    """The reply to GetCartesianLimit: a limit that is not active."""
    return reply(request, "ok", version, bytes(_LIMIT_REPLY))
