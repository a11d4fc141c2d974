"""Bytes of the ROS 2 messages in a recording, both ways, one at a time or many at once.

Written: CDR (XCDR1) little endian, encapsulation header 00 01 00 00. Read: plain CDR of either
byte order and either version (XCDR2 aligns doubles to 4 instead of 8 bytes). Alignment counts from
the byte behind the encapsulation header. Source: OMG DDS-XTypes 1.3, 7.4 (encapsulation, plain
CDR); message fields: see `ros_schemas`. Imu is only read.

Decoding is split in two: a parser finds *where* the numbers of a message lie (`Layout`), then
numpy reads them, from one message or from all messages whose other bytes are the same. Encoders
are in `cdr_encode`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.cdr_encode import SECOND_NS, CdrError, JointStateEncoder, MotionEncoder
from drivers.interface import Array

__all__ = [
    "Block",
    "CdrError",
    "JointState",
    "JointStateEncoder",
    "Layout",
    "Motion",
    "MotionEncoder",
    "decode_joint_state",
    "decode_many",
    "decode_motion",
    "parse_imu",
    "parse_joint_state",
    "parse_motion",
]

Bytes = bytes | memoryview
Rows = NDArray[np.uint8]

_STAMP = slice(4, 12)  # int32 sec, uint32 nanosec, right behind the encapsulation header
_MAX_ALIGN = {0: 8, 1: 8, 6: 4, 7: 4}  # encapsulation kind -> alignment of a double
IMU_DOUBLES = 37  # orientation 4, its covariance 9, angular velocity 3, 9, acceleration 3, 9
_LAYOUTS_VECTORISED = 16  # beyond this many layouts in one batch, messages are read one by one


@dataclass(frozen=True, slots=True)
class JointState:
    """One sensor_msgs/JointState; an absent quantity has length 0."""

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    position: Array
    velocity: Array
    effort: Array


@dataclass(frozen=True, slots=True)
class Motion:
    """One TwistStamped or AccelStamped: `vector` is (6,), linear part first."""

    stamp_ns: int
    frame_id: str
    vector: Array


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the numbers of a message lie: byte slices of its runs of doubles, and its texts."""

    little: bool
    frame_id: str
    names: tuple[str, ...]
    doubles: tuple[slice, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """Messages of one layout out of a batch.

    Attributes:
        index: (k,) their places in the batch.
        stamp_ns: (k,) header stamps, ns.
        layout: what they share.
        values: one (k, n_i) array for each run of doubles.
    """

    index: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    layout: Layout
    values: tuple[Array, ...]


class _Cursor:
    """Walks over one message."""

    def __init__(self, data: Bytes) -> None:
        if len(data) < 12:
            raise CdrError(f"message of {len(data)} bytes is too short for a header")
        kind = data[1]
        if data[0] != 0 or kind not in _MAX_ALIGN:
            raise CdrError(
                f"encapsulation {data[0]:02x} {kind:02x} is not plain CDR (00 00, 00 01, 00 06, "
                "00 07)"
            )
        self.little = bool(kind & 1)
        self._double_align = _MAX_ALIGN[kind]
        self._u32 = struct.Struct("<I" if self.little else ">I").unpack_from
        self._data = data
        self._at = _STAMP.stop

    def _advance(self, size: int, align: int) -> int:
        start = self._at + (4 - self._at) % align
        if start + size > len(self._data):
            raise CdrError(f"message ends at byte {len(self._data)}, needs {start + size}")
        self._at = start + size
        return start

    def count(self) -> int:
        number: int = self._u32(self._data, self._advance(4, 4))[0]
        return number

    def text(self) -> str:
        size = self.count()
        start = self._advance(size, 1)
        try:
            return bytes(self._data[start : start + size]).rstrip(b"\0").decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"text at byte {start} is not UTF-8") from error

    def doubles(self, number: int) -> slice:
        start = self._advance(8 * number, self._double_align) if number else self._at
        return slice(start, start + 8 * number)


def parse_joint_state(data: Bytes) -> Layout:
    """Layout of a JointState: runs position, velocity, effort. Raises CdrError."""
    cursor = _Cursor(data)
    frame_id = cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.count()))
    runs = tuple(cursor.doubles(cursor.count()) for _ in range(3))
    return Layout(cursor.little, frame_id, names, runs)


def parse_motion(data: Bytes) -> Layout:
    """Layout of a TwistStamped or AccelStamped: one run of six. Raises CdrError."""
    cursor = _Cursor(data)
    return Layout(cursor.little, cursor.text(), (), (cursor.doubles(6),))


def parse_imu(data: Bytes) -> Layout:
    """Layout of a sensor_msgs/Imu: one run of `IMU_DOUBLES`. Raises CdrError."""
    cursor = _Cursor(data)
    return Layout(cursor.little, cursor.text(), (), (cursor.doubles(IMU_DOUBLES),))


def decode_joint_state(data: Bytes) -> JointState:
    """One JointState. Raises CdrError."""
    block = _read(np.frombuffer(data, np.uint8)[None], np.zeros(1, int), parse_joint_state(data))
    position, velocity, effort = (v[0] for v in block.values)
    layout = block.layout
    return JointState(
        int(block.stamp_ns[0]), layout.frame_id, layout.names, position, velocity, effort
    )


def decode_motion(data: Bytes) -> Motion:
    """One TwistStamped or AccelStamped. Raises CdrError."""
    block = _read(np.frombuffer(data, np.uint8)[None], np.zeros(1, int), parse_motion(data))
    return Motion(int(block.stamp_ns[0]), block.layout.frame_id, block.values[0][0])


def decode_many(
    rows: Rows, parse: Callable[[Bytes], Layout]
) -> tuple[list[Block], list[tuple[int, str]]]:
    """Messages of equal size, decoded together where all but stamp and doubles is the same.

    Args:
        rows: (m, size) bytes, one message a row.
        parse: `parse_joint_state`, `parse_motion` or `parse_imu`.

    Returns:
        The blocks, and (place, reason) of messages that cannot be read.
    """
    blocks: list[Block] = []
    bad: list[tuple[int, str]] = []
    left = np.arange(len(rows))
    while left.size:
        sample = rows[left[0]]
        together = len(blocks) < _LAYOUTS_VECTORISED
        try:
            layout = parse(sample.tobytes())
        except CdrError as error:
            bad.append((int(left[0]), str(error)))
            left = left[1:]
            continue
        if together:
            candidates = rows if left.size == len(rows) else rows[left]
            same = _same_layout(candidates, sample, layout)
        else:
            same = left == left[0]
        blocks.append(_read(rows, left[same], layout))
        left = left[~same]
    return blocks, bad


def _same_layout(rows: Rows, sample: NDArray[np.uint8], layout: Layout) -> NDArray[np.bool_]:
    same = (rows[:, : _STAMP.start] == sample[: _STAMP.start]).all(axis=1)
    start = _STAMP.stop
    for run in layout.doubles:
        same &= (rows[:, start : run.start] == sample[start : run.start]).all(axis=1)
        start = run.stop
    return same


def _read(rows: Rows, index: NDArray[np.int64], layout: Layout) -> Block:
    chosen = rows if len(index) == len(rows) else rows[index]
    order = "<" if layout.little else ">"
    stamp = np.ascontiguousarray(chosen[:, _STAMP])
    sec = stamp[:, :4].copy().view(f"{order}i4")[:, 0].astype(np.int64)
    nanosec = stamp[:, 4:].copy().view(f"{order}u4")[:, 0].astype(np.int64)
    values = tuple(
        np.ascontiguousarray(chosen[:, run]).view(f"{order}f8").astype(np.float64)
        for run in layout.doubles
    )
    return Block(index, sec * SECOND_NS + nanosec, layout, values)
