"""ROS 2 messages as another encoder than ours (mcap_ros2) takes and writes them.

And recordings as other people's programs read them: every topic, without a filter.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from rosbags.highlevel import AnyReader

from drivers.files.ros_types import schemas

START_NS = 7_000_000_000

UNMEASURED = [-1.0] + [0.0] * 8  # a covariance that says so


def header(stamp_ns: int, frame: str) -> dict:
    return {"stamp": dict(zip(("sec", "nanosec"), divmod(stamp_ns, 10**9), strict=True))} | {
        "frame_id": frame
    }


def imu(stamp_ns: int, frame: str, w: np.ndarray, a: np.ndarray, **covariances) -> dict:
    """Fields of a sensor_msgs/Imu; some are left to the encoder's defaults of 0."""
    vectors = {"angular_velocity": w, "linear_acceleration": a}
    as_fields = {k: dict(zip("xyz", x.tolist(), strict=True)) for k, x in vectors.items()}
    return {"header": header(stamp_ns, frame), **covariances, **as_fields}


def joint_state(names: tuple[str, ...], at_s: float, *signals: np.ndarray) -> dict:
    """Fields of a sensor_msgs/JointState of q, dq and tau."""
    told = zip(("position", "velocity", "effort"), map(np.ndarray.tolist, signals), strict=True)
    return {"header": header(ns(at_s), ""), "name": list(names), **dict(told)}


def ns(at_s: float) -> int:
    """Stamp of a time since the start of a recording."""
    return START_NS + round(1e9 * at_s)


def write(path: Path, messages: Iterable[tuple[str, str, float, dict]]) -> Path:
    """A recording of topics, types, times and fields."""
    with path.open("wb") as file:
        writer, types = Writer(file), {}
        for topic, name, at_s, message in messages:
            if name not in types:
                types[name] = writer.register_msgdef(name, schemas()[name])
            writer.write_message(topic, types[name], message, ns(at_s), ns(at_s))
        writer.finish()
    return path


Found = dict[str, list[tuple[int, Any]]]


def by_rosbags(path: Path) -> Found:
    """By topic the log times and messages, plain mappings of fields."""
    found: Found = {}
    with AnyReader([path]) as reader:
        for connection, time_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            fields = reader.typestore.fielddefs
            found.setdefault(connection.topic, []).append((time_ns, _plain(message, fields)))
    return found


def by_mcap_ros2(path: Path) -> Found:
    """The same by mcap-ros2-support, which shares no code with rosbags."""
    found: Found = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, _slots(decoded)))
    return found


def same(a: Any, b: Any) -> bool:
    """Whether two messages say the same, not-a-number being itself."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, str | bool):
        return bool(a == b)
    if isinstance(a, list | tuple | np.ndarray) and len(a) and isinstance(a[0], dict | str):
        return len(a) == len(b) and all(map(same, a, b))
    return np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)


def assert_read_by_everybody(path: Path, topics: set[str]) -> Found:
    """Both programs read every topic and message, and find the same."""
    one, other = by_rosbags(path), by_mcap_ros2(path)
    assert one.keys() == other.keys() == topics
    for topic, messages in one.items():
        assert len(messages) == len(other[topic])
        for (at, message), (at_other, message_other) in zip(messages, other[topic], strict=True):
            assert at == at_other and same(message, message_other), topic
    return one


def _plain(value: Any, fields: Any) -> Any:
    name = getattr(value, "__msgtype__", None)
    if name is not None:
        return {key: _plain(getattr(value, key), fields) for key, _ in fields[name][1]}
    return [_plain(x, fields) for x in value] if isinstance(value, list) else value


def _slots(value: Any) -> Any:
    if hasattr(value, "__slots__") and not isinstance(value, np.ndarray):
        return {key: _slots(getattr(value, key)) for key in value.__slots__}
    return [_slots(x) for x in value] if isinstance(value, list) else value
