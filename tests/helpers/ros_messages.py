"""Fields of ROS 2 messages as another encoder than ours (mcap_ros2) takes them."""

from __future__ import annotations

import numpy as np

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
