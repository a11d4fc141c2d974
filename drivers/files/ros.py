"""Bytes of the ROS 2 messages in a recording, both ways, one at a time or many at once.

Written: CDR (XCDR1) little endian, encapsulation header 00 01 00 00. Read: plain CDR of either
byte order and either version (XCDR2 aligns doubles to 4 instead of 8 bytes). Alignment counts from
the byte behind the encapsulation header. Source: OMG DDS-XTypes 1.3, 7.4 (encapsulation, plain
CDR). Imu and Odometry are only read, and so is the beginning of three more messages of joints:
control_msgs/DynamicJointState (ros-controls/control_msgs), franka_msgs/FrankaRobotState and
franka_msgs/FrankaState (frankaemika/franka_ros2).

Decoding is split in two: a parser finds *where* the numbers of a message lie (`Layout`), then
numpy reads them, from one message or from all messages whose other bytes are the same. Encoders
lay out the constant bytes of a message once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Array

CDR_LE = b"\x00\x01\x00\x00"
SECOND_NS = 1_000_000_000
_STAMP_LE = struct.Struct("<iI")
_SEC_LIMIT = 2**31
Bytes = bytes | memoryview
Rows = NDArray[np.uint8]
_STAMP = slice(4, 12)  # int32 sec, uint32 nanosec, right behind the encapsulation header
_MAX_ALIGN = {0: 8, 1: 8, 6: 4, 7: 4}  # encapsulation kind -> alignment of a double
IMU_DOUBLES = 37  # orientation 4, its covariance 9, angular velocity 3, 9, acceleration 3, 9
ODOMETRY_DOUBLES = 85  # pose 7, its covariance 36, twist 6 (child frame), its covariance 36
TRANSFORM_DOUBLES = 7  # translation 3, rotation 4
_COLLISION_DOUBLES = (
    26  # flags before the joint state of a FrankaRobotState: 4 vectors, 2 of joints
)
_FRANKA_JOINTS = 7  # of the fixed arrays of a FrankaState, of which these follow its header:
_FRANKA_RUNS = (
    "",
    "",
    "q",
    "",
    "dq",
    "",
    "",
    "",
    "",
    "tau",
)  # between: q_d dq_d ddq_d theta dtheta
_FRANKA_FLAGS = 6  # doubles of each of the first two
_LAYOUTS_VECTORISED = 16  # beyond this many layouts in one batch, messages are read one by one


class CdrError(ValueError):
    """A message is not what its schema says, or values don't fit one."""


class _MessageBuilder:
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

    def rest(self) -> bytes:
        """What follows the last run of doubles."""
        return bytes(self._piece)


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
        body = _MessageBuilder()
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


def encode_joint_trajectory(
    joint_names: Sequence[str], times_ns: NDArray[np.int64], motion: Array
) -> bytes:
    """One JointTrajectory, without efforts, its stamp 0: to be started when it comes.

    Args:
        joint_names: n of them.
        times_ns: (m,) from the start.
        motion: (m, 3, n) q, dq, ddq: rad, rad/s, rad/s².
    """
    n, body = len(joint_names), _MessageBuilder()
    body.text("")
    body.count(n)
    for name in joint_names:
        body.text(name)
    body.count(len(times_ns))
    parts: list[bytes] = []
    for since_ns, point in zip(times_ns, motion, strict=True):
        for row in point:
            body.count(n)
            body.doubles(n)
            parts += [body.pieces[-1], _raw(row, (n,), "point")]
        body.count(0)  # efforts
        for value in divmod(int(since_ns), SECOND_NS):
            body.count(value)
    return b"".join((CDR_LE, _stamp(0), *parts, body.rest()))


class MotionEncoder:
    """Encodes TwistStamped or AccelStamped (same bytes) of one frame."""

    def __init__(self, frame_id: str) -> None:
        body = _MessageBuilder()
        body.text(frame_id)
        body.doubles(6)
        (self._piece,) = body.pieces

    def encode(self, stamp_ns: int, vector: Array) -> bytes:
        """One message of a (6,) vector, linear part first. Raises CdrError on a wrong shape."""
        return b"".join((CDR_LE, _stamp(stamp_ns), self._piece, _raw(vector, (6,), "vector")))


class ImuEncoder(MotionEncoder):
    """Encodes Imu of one frame, without an orientation."""

    def __init__(self, frame_id: str) -> None:
        body = _MessageBuilder()
        body.text(frame_id)
        body.doubles(IMU_DOUBLES)
        (self._piece,) = body.pieces

    def encode(self, stamp_ns: int, vector: Array) -> bytes:
        """One message of [w; a] (6,). Raises CdrError on a wrong shape."""
        whole = np.zeros(IMU_DOUBLES)
        whole[3], whole[4] = 1.0, -1.0  # no turn, and its covariance says that nothing is known
        whole[13:16], whole[25:28] = vector[:3], vector[3:]
        raw = _raw(whole, (IMU_DOUBLES,), "vector")
        return b"".join((CDR_LE, _stamp(stamp_ns), self._piece, raw))


class TransformsEncoder:
    """Encodes tf2_msgs/TFMessage of the same frames; about 20 µs a message.

    Args:
        frames: (parent, child) of each transform.
    """

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        data = bytearray(struct.pack("<I", len(frames)))
        stamps, numbers = [], []
        for pair in frames:
            data += bytes(-len(data) % 4)
            stamps.append(len(data))
            data += bytes(8)
            for text in pair:
                raw = text.encode() + b"\0"
                data += bytes(-len(data) % 4) + struct.pack("<I", len(raw)) + raw
            data += bytes(-len(data) % 8)
            numbers.append(len(data))
            data += bytes(8 * TRANSFORM_DOUBLES)
        self._template = np.frombuffer(CDR_LE + bytes(data), np.uint8)
        starts = np.add(len(CDR_LE), np.array([stamps, numbers]).reshape(2, -1))
        self._stamps = starts[0][:, None] + np.arange(8)
        self._numbers = starts[1][:, None] + np.arange(8 * TRANSFORM_DOUBLES)

    def encode(self, stamp_ns: int, numbers: Array) -> bytes:
        """One message of rows (m, 7): x y z in m, quaternion x y z w.

        Raises CdrError on a wrong shape.
        """
        if numbers.shape != (len(self._numbers), TRANSFORM_DOUBLES):
            raise CdrError(f"transforms have shape {numbers.shape}")
        data = self._template.copy()
        data[self._stamps] = np.frombuffer(_stamp(stamp_ns), np.uint8)
        data[self._numbers] = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
        return data.tobytes()


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the numbers of a message lie.

    Attributes:
        little: byte order.
        frame_id, names: its texts.
        doubles: places of the bytes of its runs of doubles.
        varying: what else than the stamp may differ in messages of this layout; `doubles` where
            empty. Behind the last of them nothing is looked at.
    """

    little: bool
    frame_id: str
    names: tuple[str, ...]
    doubles: tuple[slice | NDArray[np.int64], ...]
    varying: tuple[slice, ...] = ()


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

    def stamp(self) -> slice:
        start = self._advance(8, 4)
        return slice(start, start + 8)

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


def parse_franka_robot_state(data: Bytes) -> Layout:
    """Layout of a FrankaRobotState: the runs of its measured joint state. Raises CdrError."""
    cursor = _Cursor(data)
    cursor.text()
    flags = cursor.doubles(_COLLISION_DOUBLES)
    stamp = cursor.stamp()
    frame_id = cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.count()))
    runs = tuple(cursor.doubles(cursor.count()) for _ in range(3))
    return Layout(cursor.little, frame_id, names, runs, (flags, stamp, *runs))


def parse_franka_state(data: Bytes) -> Layout:
    """Layout of a FrankaState of ROS 2, whose joints have no names: joint1, joint2, ...

    Raises:
        CdrError: it is no such message.
    """
    cursor = _Cursor(data)
    frame_id = cursor.text()
    runs = [cursor.doubles(_FRANKA_FLAGS if i < 2 else _FRANKA_JOINTS) for i in range(10)]
    named = dict(zip(_FRANKA_RUNS, runs, strict=True))
    names = tuple(f"joint{i + 1}" for i in range(_FRANKA_JOINTS))
    doubles = (named["q"], named["dq"], named["tau"])
    return Layout(cursor.little, frame_id, names, doubles, tuple(runs))


def parse_dynamic_joint_state(data: Bytes) -> Layout:
    """Layout of a DynamicJointState: position, velocity, effort of the joints that have them.

    Interfaces that only some of the joints with a position (and effort, if any has one) tell
    are absent. Raises CdrError.
    """
    cursor = _Cursor(data)
    frame_id = cursor.text()
    joints = [cursor.text() for _ in range(cursor.count())]
    places: dict[str, dict[str, int]] = {}
    runs = []
    for index in range(cursor.count()):
        interfaces = [cursor.text() for _ in range(cursor.count())]
        run = cursor.doubles(cursor.count())
        if index >= len(joints) or run.stop - run.start != 8 * len(interfaces):
            raise CdrError("names and values differ in number")
        places[joints[index]] = {name: run.start + 8 * k for k, name in enumerate(interfaces)}
        runs.append(run)
    named = [name for name in joints if "position" in places.get(name, ())]
    names = [name for name in named if "effort" in places[name]] or named
    doubles = []
    for quantity in ("position", "velocity", "effort"):
        starts = [places[name][quantity] for name in names if quantity in places[name]]
        starts = starts if len(starts) == len(names) else []
        doubles.append(np.add.outer(starts, np.arange(8)).ravel().astype(np.int64))
    return Layout(cursor.little, frame_id, tuple(names), tuple(doubles), tuple(runs))


def parse_motion(data: Bytes) -> Layout:
    """Layout of a TwistStamped or AccelStamped: one run of six. Raises CdrError."""
    cursor = _Cursor(data)
    return Layout(cursor.little, cursor.text(), (), (cursor.doubles(6),))


def parse_imu(data: Bytes) -> Layout:
    """Layout of a sensor_msgs/Imu: one run of `IMU_DOUBLES`. Raises CdrError."""
    cursor = _Cursor(data)
    return Layout(cursor.little, cursor.text(), (), (cursor.doubles(IMU_DOUBLES),))


def parse_odometry(data: Bytes) -> Layout:
    """Layout of a nav_msgs/Odometry: one run of `ODOMETRY_DOUBLES`; its frame is the child's.

    Raises:
        CdrError: it is no such message.
    """
    cursor = _Cursor(data)
    cursor.text()  # the frame that the pose is told in
    return Layout(cursor.little, cursor.text(), (), (cursor.doubles(ODOMETRY_DOUBLES),))


def decode_many(
    rows: Rows, parse: Callable[[Bytes], Layout]
) -> tuple[list[Block], list[tuple[int, str]]]:
    """Messages of equal size, decoded together where all but stamp and doubles is the same.

    Args:
        rows: (m, size) bytes, one message a row.
        parse: one of the `parse_` above.

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
    for run in layout.varying or layout.doubles:
        assert isinstance(run, slice)
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
