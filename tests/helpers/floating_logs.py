"""Recordings of robots in free motion, with noise, as ROS 2 tools write them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from adapter.learning.tree_data import TreeData
from adapter.model.spatial import Array
from drivers.files.ros_types import (
    ACCEL_STAMPED,
    IMU,
    JOINT_STATE,
    ODOMETRY,
    TWIST_STAMPED,
)
from tests.helpers.ros_messages import header, imu, joint_state, ns, write

# Of usual parts, one sample each: rad, rad/s, share of a joint's torque; rad/s, m/s², m/s.
Q_STD, DQ_STD, TAU_SHARE, W_STD, A_STD, V_STD = 2e-5, 2e-3, 0.02, 3e-3, 3e-2, 5e-3


class Mount(NamedTuple):
    """An Imu's frame on the base: its name, rotation (3, 3) and place (3,) there."""

    name: str
    rotation: Array
    place: Array


class Rates(NamedTuple):
    """Of joint states and of the base's motion, Hz."""

    joints: float = 1000.0
    base: float = 500.0


def record(
    path: Path,
    data: TreeData,
    seed: int | None,
    base: str = "base",
    mount: Mount | None = None,
    rates: Rates = Rates(),  # noqa: B008  # never changed
) -> Path:
    """Joint states, and the base's motion with stamps of its own.

    It is told by an Imu on the base and an Odometry, or, where no Imu is mounted, by TwistStamped
    and AccelStamped.

    Args:
        data: at the rate of the joint states.
        seed: of the noise; none where None.
        base: name of the base's frame.
    """
    rng = np.random.default_rng(seed)

    def noisy(x: Array, std: float | Array) -> Array:
        return np.asarray(x if seed is None else x + std * rng.normal(size=x.shape))

    t, tau = np.arange(len(data)) / rates.joints, data.tau[:, -data.tree.n :]
    joints = noisy(data.q, Q_STD), noisy(data.dq, DQ_STD), noisy(tau, TAU_SHARE * tau.std(axis=0))
    messages = [
        ("/joint_states", JOINT_STATE, at, joint_state(data.tree.joint_names, at, *row))
        for at, *row in zip(t, *joints, strict=True)
    ]
    own = np.arange(0.0003, t[-1], 1.0 / rates.base)
    motion = np.concatenate([data.base.v, data.base.w, data.base.a, data.base.dw], axis=1)
    motion = np.stack([np.interp(own, t, x) for x in motion.T], axis=1)
    v, w, a, dw = np.split(motion, 4, axis=1)
    seen, spun = noisy(v, V_STD), noisy(w, W_STD)
    if mount is None:
        felt = noisy(a, A_STD)
        for at, *row in zip(own, seen, spun, felt, dw, strict=True):
            head = header(ns(at), base)
            messages.append(
                ("/twist", TWIST_STAMPED, at, {"header": head, "twist": _six(*row[:2])})
            )
            messages.append(
                ("/accel", ACCEL_STAMPED, at, {"header": head, "accel": _six(*row[2:])})
            )
    else:
        arm = mount.place
        felt = noisy(a + np.cross(dw, arm) + np.cross(w, np.cross(w, arm)), A_STD)
        for at, *row in zip(own, seen, spun, felt, strict=True):
            turned = (x @ mount.rotation for x in row[1:])
            messages.append(("/imu", IMU, at, imu(ns(at), mount.name, *turned)))
            child = {"header": header(ns(at), "odom"), "child_frame_id": base}
            twist = {"twist": {"twist": _six(*row[:2])}}
            messages.append(("/odom", ODOMETRY, at, {**child, **twist}))
    return write(path, messages)


def _six(linear: Array, angular: Array) -> dict:
    parts = zip(("linear", "angular"), (linear, angular), strict=True)
    return {key: dict(zip("xyz", x.tolist(), strict=True)) for key, x in parts}
