"""Writes recordings: MCAP, profile ros2, zstd chunks, handed to the system within half a second."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from drivers.files.messages import (
    ImuEncoder,
    JointStateEncoder,
    Message,
    MotionEncoder,
    encode,
    header,
)
from drivers.files.ros import SECOND_NS, CdrError
from drivers.files.ros_types import (
    ACCEL_STAMPED,
    IMU,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    TWIST_STAMPED,
    schemas,
)
from drivers.interface import Array, DriverError, JointSample, LinkMotion

JOINT_STATES = "/joint_states"
JOINT_COMMANDS = "/joint_commands"
EXTERNAL_TORQUES = "/external_torques"
LINK_TWISTS = "/link_twists/"
LINK_ACCELS = "/link_accels/"
ESTIMATES = "/estimates"
METADATA = "panda_adapter"  # name of the metadata record with our own settings
LIBRARY = "panda-adapter"
FLUSH_S = 0.5  # a killed recorder loses less than this and the chunk being written
_FOREVER = "    sec: 9223372036\n    nsec: 854775807\n"


def _qos(history: int, depth: int, durability: int) -> str:
    """Quality of service as rosbag2 writes it into a channel, in numbers of ROS's middleware."""
    lines = (
        f"- history: {history}\n  depth: {depth}\n  reliability: 1\n  durability: {durability}\n"
    )
    spans = "".join(
        f"  {what}:\n{_FOREVER}" for what in ("deadline", "lifespan", "liveliness_lease_duration")
    )
    return f"{lines}{spans}  liveliness: 1\n  avoid_ros_namespace_conventions: false\n"


def to_json(value: Any) -> str:
    """JSON of numbers, texts, arrays and mappings of them; not-a-number becomes null."""
    return json.dumps(_plain(value), allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, str | int | bool | type(None)) else str(value)


class McapWriter:
    """A recording being written. Call from one thread, outside the real-time loop.

    Whatever was written is handed to the operating system, in a closed chunk, at the first write
    later than `flush_s` after it; call `flush` where writes may pause. A kill -9 then costs
    `flush_s` at most.

    Args:
        path: the file; its folder must exist.
        joint_names: order of the joint arrays.
        link_names: order of the rows of LinkMotion; link i is moved by joint i.
        metadata: configuration, version, ...: anything JSON can hold.
        overwrite: replace an existing file instead of refusing.

    Raises:
        DriverError: the file exists or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        joint_names: Sequence[str],
        link_names: Sequence[str] = (),
        metadata: Mapping[str, Any] | None = None,
        *,
        flush_s: float = FLUSH_S,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.joint_names = tuple(joint_names)
        self.link_names = tuple(link_names)
        self.messages = 0
        self._flush_s = flush_s
        self._oldest: float | None = None  # monotonic time of the oldest message not on disk
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._states = JointStateEncoder(self.joint_names)
        self._commands = JointStateEncoder(self.joint_names, fields=("effort",))
        self._positions = JointStateEncoder(self.joint_names, fields=("position",))
        self._motions = tuple((name, MotionEncoder(name)) for name in self.link_names)
        self._imus = tuple(ImuEncoder(name) for name in self.link_names)
        try:
            self._file = self.path.open("wb" if overwrite else "xb")
        except FileExistsError as error:
            raise DriverError(f"{path}: exists; choose another name or delete it") from error
        except OSError as error:
            raise DriverError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = Writer(self._file)
        self._writer.start(profile="ros2", library=LIBRARY)
        names = {"joint_names": self.joint_names, "link_names": self.link_names}
        self.add_metadata(METADATA, {**names, **(metadata or {})})

    def write(self, sample: JointSample) -> None:
        """Record a sample: joint state, and link motion where it has any."""
        self.write_joint_state(sample.stamp_ns, sample.q, sample.dq, sample.tau)
        if sample.links is not None:
            self.write_links(sample.stamp_ns, sample.links)

    def write_joint_state(self, stamp_ns: int, q: Array, dq: Array, tau: Array) -> None:
        """Record (n,) positions, velocities and torques: rad, rad/s, N m."""
        self._write_state(JOINT_STATES, self._states, stamp_ns, (q, dq, tau))

    def write_trajectory(self, times_ns: NDArray[np.int64], motion: Array) -> None:
        """Write a planned motion as one trajectory: (m,) from its start, (m, 3, n) q, dq, ddq."""
        points = []
        for since_ns, rows in zip(times_ns.tolist(), motion, strict=True):
            after = dict(zip(("sec", "nanosec"), divmod(since_ns, SECOND_NS), strict=True))
            point = zip(("positions", "velocities", "accelerations"), rows, strict=True)
            points.append({**dict(point), "effort": (), "time_from_start": after})
        fields = {"header": header(0), "joint_names": self.joint_names, "points": points}
        self.write_message(Message("/joint_trajectory", JOINT_TRAJECTORY, 0, fields))

    def write_links(self, stamp_ns: int, links: LinkMotion) -> None:
        """Record the measured motion of the links, in the order of `link_names`.

        Where w and a are all that is told of any link, each is what an Imu on the link read.
        """
        expected = (len(self._motions), 6)
        if links.twist.shape != expected or links.accel.shape != expected:
            raise DriverError(
                f"{self.path}: link motion of shapes {links.twist.shape} and {links.accel.shape}, "
                f"expected {expected} for the links {', '.join(self.link_names) or '(none named)'}"
            )
        heard = np.isfinite(links.twist[:, 3:]).all(axis=1)
        if np.isnan(links.twist[:, :3]).all() and np.isnan(links.accel[:, 3:]).all():
            for i in np.flatnonzero(heard):
                told = np.concatenate([links.twist[i, 3:], links.accel[i, :3]])
                channel = self._channel(f"/link_imus/{self.link_names[i]}", IMU)
                self._add(channel, stamp_ns, self._imus[i].encode(stamp_ns, told))
            return
        for (name, encoder), twist, accel in zip(
            self._motions, links.twist, links.accel, strict=True
        ):
            twist_channel = self._channel(LINK_TWISTS + name, TWIST_STAMPED)
            self._add(twist_channel, stamp_ns, encoder.encode(stamp_ns, twist))
            accel_channel = self._channel(LINK_ACCELS + name, ACCEL_STAMPED)
            self._add(accel_channel, stamp_ns, encoder.encode(stamp_ns, accel))

    def write_command(self, stamp_ns: int, tau: Array) -> None:
        """Record (n,) commanded joint torques, N m."""
        self._write_state(JOINT_COMMANDS, self._commands, stamp_ns, (tau, tau, tau))

    def write_position(self, stamp_ns: int, q: Array) -> None:
        """Record (n,) positions of an arm that tells nothing else, rad."""
        self._write_state(JOINT_STATES, self._positions, stamp_ns, (q, q, q))

    def write_position_command(self, stamp_ns: int, q: Array) -> None:
        """Record (n,) commanded joint positions, rad."""
        self._write_state(JOINT_COMMANDS, self._positions, stamp_ns, (q, q, q))

    def write_external(self, stamp_ns: int, tau: Array) -> None:
        """Record (n,) torques that the surroundings put on the joints, N m."""
        self._write_state(EXTERNAL_TORQUES, self._commands, stamp_ns, (tau, tau, tau))

    def write_message(self, message: Message) -> None:
        """Record a message of any type that `ros_types.schemas` defines."""
        try:
            data = encode(message.schema, message.fields)
        except CdrError as error:
            raise DriverError(f"{self.path}: message on {message.topic}: {error}") from error
        channel = self._channel(message.topic, message.schema, message.latched)
        self._add(channel, message.stamp_ns, data)

    def add_metadata(self, name: str, values: Mapping[str, Any]) -> None:
        """Add a metadata record at once, each value as JSON text."""
        with _naming(self.path):
            self._writer.add_metadata(name, {k: to_json(v) for k, v in values.items()})
        self.flush()

    def attach(self, name: str, data: bytes, media_type: str = "application/json") -> None:
        """Add a file (a model, a configuration) to the recording at once."""
        now = time.time_ns()
        with _naming(self.path):
            self._writer.add_attachment(now, now, name, media_type, data)
        self.flush()

    def flush(self) -> None:
        """Close the open chunk and hand it to the operating system."""
        with _naming(self.path):
            self._writer.flush()
        self._oldest = None

    def close(self) -> None:
        """Write the index and close the file; may be called more than once."""
        if self._file.closed:
            return
        with _naming(self.path):
            try:
                self._writer.finish()
            finally:
                self._file.close()

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _write_state(
        self, topic: str, encoder: JointStateEncoder, stamp_ns: int, signals: tuple[Array, ...]
    ) -> None:
        try:
            data = encoder.encode(stamp_ns, *signals)
        except CdrError as error:
            raise DriverError(f"{self.path}: sample of {stamp_ns} ns: {error}") from error
        self._add(self._channel(topic, JOINT_STATE), stamp_ns, data)

    def _channel(self, topic: str, schema: str, latched: bool = False) -> int:
        number = self._channels.get(topic)
        if number is None:
            if schema not in self._schemas:
                text = schemas()[schema].encode()
                self._schemas[schema] = self._writer.register_schema(schema, "ros2msg", text)
            depth, durability = (1, 1) if latched else (10, 2)  # transient local, or volatile
            offered = {"offered_qos_profiles": _qos(1, depth, durability)}
            of = self._schemas[schema]
            number = self._writer.register_channel(topic, "cdr", of, offered)
            self._channels[topic] = number
        return number

    def _add(self, channel: int, stamp_ns: int, data: bytes) -> None:
        # Log times cannot be negative; the header stamp keeps what the arm said.
        log_time = max(int(stamp_ns), 0)
        with _naming(self.path):
            self._writer.add_message(channel, log_time, data, log_time, self.messages)
        self.messages += 1
        now = time.monotonic()
        if self._oldest is None:
            self._oldest = now
        elif now - self._oldest >= self._flush_s:
            self.flush()


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Turns a full disk and the like into a DriverError that names the file."""
    try:
        yield
    except OSError as error:
        raise DriverError(
            f"{path}: cannot be written ({error.strerror}); what was recorded before stays readable"
        ) from error
