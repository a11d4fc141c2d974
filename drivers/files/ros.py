"""Reads the ROS 2 messages of joints, links and bases in a recording, one or many at once.

Plain CDR of either byte order and either version (XCDR2 aligns doubles to 4 instead of 8 bytes).
Alignment counts from the byte behind the encapsulation header. Source: OMG DDS-XTypes 1.3, 7.4
(encapsulation, plain CDR). Of four messages of joints only the beginning is read:
control_msgs/DynamicJointState and JointTrajectoryControllerState (ros-controls/control_msgs),
franka_msgs/FrankaRobotState and FrankaState (frankaemika/franka_ros2).

Decoding is split in two: a parser finds *where* the numbers of a message lie (`Layout`), then
numpy reads them, from one message or from all messages whose other bytes are the same.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.interface import Array

SECOND_NS = 1_000_000_000
Bytes = bytes | memoryview
Rows = NDArray[np.uint8]
_STAMP = slice(4, 12)  # int32 sec, uint32 nanosec, right behind the encapsulation header
_MAX_ALIGN = {0: 8, 1: 8, 6: 4, 7: 4}  # encapsulation kind -> alignment of a double
IMU_DOUBLES = 37  # orientation 4, its covariance 9, angular velocity 3, 9, acceleration 3, 9
ODOMETRY_DOUBLES = 85  # pose 7, its covariance 36, twist 6 (child frame), its covariance 36
# flags before the joint state of a FrankaRobotState: 4 vectors, 2 of joints
# of a FrankaState behind its header: two of flags, q q_d dq dq_d ddq_d theta dtheta tau
_FRANKA_RUNS = (6, 6, 7, 7, 7, 7, 7, 7, 7, 7)


class CdrError(ValueError):
    """A message is not what its schema says, or values don't fit one."""


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
        index: (k,) their places in the batch; of a topic's messages, in the topic's order.
        stamp_ns: (k,) header stamps, ns.
        layout: what they share.
        values: one (k, n_i) array for each run of doubles.
        log_ns: (k,) log times, where they are of a topic.
    """

    index: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    layout: Layout
    values: tuple[Array, ...]
    log_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


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
        return self._u32(self._data, self._advance(4, 4))[0]

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

    def joint_state(self) -> tuple[str, tuple[str, ...], tuple[slice, ...]]:
        """Frame, names and runs of a JointState, behind its stamp."""
        frame_id = self.text()
        names = tuple(self.text() for _ in range(self.count()))
        return frame_id, names, tuple(self.doubles(self.count()) for _ in range(3))


def parse_joint_state(data: Bytes) -> Layout:
    """Layout of a JointState: runs position, velocity, effort. Raises CdrError."""
    cursor = _Cursor(data)
    frame_id, names, runs = cursor.joint_state()
    return Layout(cursor.little, frame_id, names, runs)


def parse_franka_robot_state(data: Bytes) -> Layout:
    """Layout of a FrankaRobotState: the runs of its measured joint state. Raises CdrError."""
    cursor = _Cursor(data)
    cursor.text()
    flags = cursor.doubles(26)
    stamp = cursor.stamp()
    frame_id, names, runs = cursor.joint_state()
    return Layout(cursor.little, frame_id, names, runs, (flags, stamp, *runs))


def parse_franka_state(data: Bytes) -> Layout:
    """Layout of a FrankaState of ROS 2, whose joints have no names: joint1, joint2, ...

    Raises:
        CdrError: it is no such message.
    """
    cursor = _Cursor(data)
    frame_id = cursor.text()
    runs = tuple(cursor.doubles(number) for number in _FRANKA_RUNS)
    names = tuple(f"joint{i + 1}" for i in range(_FRANKA_RUNS[-1]))
    return Layout(cursor.little, frame_id, names, (runs[2], runs[4], runs[-1]), runs)


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


def parse_controller_state(data: Bytes) -> Layout:
    """Layout of a JointTrajectoryControllerState: runs of its feedback, then reference positions.

    All its versions begin so; the oldest call these two actual and desired. Raises CdrError.
    """
    cursor = _Cursor(data)
    frame_id = cursor.text()
    names = tuple(cursor.text() for _ in range(cursor.count()))
    runs: list[slice] = []
    for _ in ("reference", "feedback"):  # position, velocity, acceleration, effort and a duration
        runs += (cursor.doubles(cursor.count()) for _ in range(4))
        runs.append(cursor.stamp())
    goal, _, _, _, _, position, velocity, _, effort, _ = runs
    return Layout(cursor.little, frame_id, names, (position, velocity, effort, goal), tuple(runs))


def parse_doubles(data: Bytes, number: int, of_child: bool = False) -> Layout:
    """Layout of a header, the name of a child frame where it is `of_child`, and a run of doubles.

    So are TwistStamped and AccelStamped (6), Imu (`IMU_DOUBLES`) and Odometry (`ODOMETRY_DOUBLES`;
    its frame is the child's). Raises CdrError.
    """
    cursor = _Cursor(data)
    if of_child:
        cursor.text()  # the frame that the pose is told in
    return Layout(cursor.little, cursor.text(), (), (cursor.doubles(number),))


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
        try:
            layout = parse(sample.tobytes())
        except CdrError as error:
            bad.append((int(left[0]), str(error)))
            left = left[1:]
            continue
        if len(blocks) < 16:  # beyond this many layouts in one batch, messages are read one by one
            candidates = rows if left.size == len(rows) else rows[left]
            same, start = np.ones(len(candidates), dtype=np.bool_), 0
            for run in (_STAMP, *(layout.varying or layout.doubles)):
                assert isinstance(run, slice)
                fixed = candidates[:, start : run.start] == sample[start : run.start]
                if not fixed.all():  # all at once is four times as fast as row by row
                    same &= fixed.all(axis=1)
                start = run.stop
        else:
            same = left == left[0]
        blocks.append(_read(rows, left[same], layout))
        left = left[~same]
    return blocks, bad


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
