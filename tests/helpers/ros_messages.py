"""ROS 2 messages as another encoder than ours (mcap_ros2) takes and writes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from mcap_ros2.writer import Writer

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
