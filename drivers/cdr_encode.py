"""Encoders of the messages in a recording; the constant bytes are laid out once per encoder."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from drivers.interface import Array

CDR_LE = b"\x00\x01\x00\x00"
SECOND_NS = 1_000_000_000
_STAMP_LE = struct.Struct("<iI")
_SEC_LIMIT = 2**31


class CdrError(ValueError):
    """A message is not what its schema says, or values don't fit one."""


class _Body:
    """Builds the constant stretches of a message: everything but its stamp and its doubles."""

    def __init__(self) -> None:
        self._size = 8  # the stamp
        self._piece = bytearray()
        self.pieces: list[bytes] = []

    def _put(self, data: bytes, align: int) -> None:
        padding = -self._size % align
        self._piece += bytes(padding) + data
        self._size += padding + len(data)

    def text(self, value: str) -> None:
        data = value.encode() + b"\0"
        self.count(len(data))
        self._put(data, 1)

    def count(self, value: int) -> None:
        self._put(struct.pack("<I", value), 4)

    def doubles(self, number: int) -> None:
        """End the stretch where `number` doubles go; an empty run isn't aligned."""
        if number:
            self._put(b"", 8)
        self.pieces.append(bytes(self._piece))
        self._piece.clear()
        self._size += 8 * number


def _stamp(stamp_ns: int) -> bytes:
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    if not -_SEC_LIMIT <= sec < _SEC_LIMIT:
        raise CdrError(f"stamp {stamp_ns} ns does not fit a ROS time (32 bit seconds)")
    return _STAMP_LE.pack(sec, nanosec)


def _raw(values: Array, shape: tuple[int], what: str) -> bytes:
    data = np.asarray(values, dtype="<f8")
    if data.shape != shape:
        raise CdrError(f"{what} has shape {data.shape}, expected {shape}")
    return data.tobytes()


class JointStateEncoder:
    """Encodes JointState messages of the same joints; about 3 µs a message.

    Args:
        names: the joints, in the order of the arrays.
        frame_id: of the header.
        fields: which of position, velocity and effort the messages carry.
    """

    def __init__(
        self,
        names: Sequence[str],
        frame_id: str = "",
        fields: Sequence[str] = ("position", "velocity", "effort"),
    ) -> None:
        self._shape = (len(names),)
        body = _Body()
        body.text(frame_id)
        body.count(len(names))
        for name in names:
            body.text(name)
        for field in ("position", "velocity", "effort"):
            number = len(names) if field in fields else 0
            body.count(number)
            body.doubles(number)
        self._pieces = tuple(body.pieces)
        self._has = tuple(f in fields for f in ("position", "velocity", "effort"))

    def encode(self, stamp_ns: int, q: Array, dq: Array, tau: Array) -> bytes:
        """One message; arrays of absent fields are ignored. Raises CdrError on wrong shapes."""
        first, second, third = self._pieces
        has_q, has_dq, has_tau = self._has
        return b"".join(
            (
                CDR_LE,
                _stamp(stamp_ns),
                first,
                _raw(q, self._shape, "position") if has_q else b"",
                second,
                _raw(dq, self._shape, "velocity") if has_dq else b"",
                third,
                _raw(tau, self._shape, "effort") if has_tau else b"",
            )
        )


class MotionEncoder:
    """Encodes TwistStamped or AccelStamped (same bytes) of one frame."""

    def __init__(self, frame_id: str) -> None:
        body = _Body()
        body.text(frame_id)
        body.doubles(6)
        (self._piece,) = body.pieces

    def encode(self, stamp_ns: int, vector: Array) -> bytes:
        """One message of a (6,) vector, linear part first. Raises CdrError on a wrong shape."""
        return b"".join((CDR_LE, _stamp(stamp_ns), self._piece, _raw(vector, (6,), "vector")))
