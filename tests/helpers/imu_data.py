"""Recordings of a bent Panda with sensors glued on its links, in motion by Pinocchio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

from adapter.model.spatial import exp_rotation
from drivers.files.mcap import FrameMotion, Log
from drivers.files.ros_types import IMU, JOINT_STATE
from sim.scenarios import build
from sim.truth import Truth
from tests.helpers.arm_data import Motion, pin_model, rnea, trajectory
from tests.helpers.robot_models import frame_motion
from tests.helpers.ros_messages import START_NS, imu, joint_state, ns, write


@dataclass(frozen=True)
class Parts:
    """What sensors are like: small MEMS parts.

    Attributes:
        rate_hz: readings a second; joints_hz: joint states a second.
        w_noise, a_noise: of a reading, rad/s, m/s²; w_bias, a_bias: at most.
        late_s: at most, of the stamps; q_noise: rad.
    """

    rate_hz: float = 400.0
    joints_hz: float = 1000.0
    w_noise: float = 1.75e-3
    a_noise: float = 0.05
    w_bias: float = np.radians(0.5)
    a_bias: float = 0.2
    late_s: float = 0.004
    q_noise: float = 3e-4


@dataclass(frozen=True)
class Glued:
    """A recording in memory: joints (m,), (m, n), and of each sensor its link, stamps, w and a."""

    truth: Truth
    t_s: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    sensors: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]

    def log(self, frames: Mapping[int, str] | None = None) -> Log:
        """As it is read; frames are the links' names where not given."""
        frames = frames or dict(enumerate(self.truth.link_names))
        told = tuple(
            FrameMotion(f"/imu{i + 1}", IMU, frames[i], _ns(t_s), w, a, np.full_like(w, np.nan))
            for i, (t_s, w, a) in self.sensors.items()
        )
        path, signals = Path("glued.mcap"), (self.q, self.dq, self.tau)
        return Log(path, self.truth.joint_names, _ns(self.t_s), *signals, frames=told)

    def write(self, path: Path, frames: Mapping[int, str] | None = None) -> Path:
        """As ROS 2 tools write it."""
        frames = frames or dict(enumerate(self.truth.link_names))
        rows = zip(self.t_s, self.q, self.dq, self.tau, strict=True)
        messages = [
            ("/joint_states", JOINT_STATE, at, joint_state(self.truth.joint_names, at, *row))
            for at, *row in rows
        ]
        for i, readings in self.sensors.items():
            for at, *pair in zip(*readings, strict=True):
                messages.append((f"/imu{i + 1}", IMU, at, imu(ns(at), frames[i], *pair)))
        return write(path, messages)


def _ns(at: np.ndarray) -> np.ndarray:
    return START_NS + np.round(1e9 * np.asarray(at)).astype(np.int64)


def links_of(truth: Truth, motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (k,) 5 ms apart, and at these torques (k, n) and [w, dw, a with gravity] (k, n, 9) of
    each link in its frame."""
    model = pin_model(truth)
    data, g = model.createData(), model.gravity.linear
    q, dq, ddq = (x[::5] for x in trajectory(motion))
    out = np.empty((*q.shape, 9))
    for row, x in zip(out, zip(q, dq, ddq, strict=True), strict=True):
        pin.forwardKinematics(model, data, *x)
        for i in range(truth.n):
            row[i] = frame_motion(model, data, i + 1, np.eye(3), g)[[1, 3, 2]].ravel()
    return 5e-3 * np.arange(len(q)), rnea(model, q, dq, ddq), out


def record(seed: int, links: Sequence[int], seconds: float, parts: Parts | None = None) -> Glued:
    """A bent Panda in motion, with sensors on these links, mounted anyhow."""
    parts, rng = parts or Parts(), np.random.default_rng([seed, 19])
    truth, motion = build("bent_link", seed).truth, Motion(seconds, seed)
    q, dq, _ = trajectory(motion)
    grid = np.arange(len(q) - 5) * 1e-3  # within the knots
    q, dq = q[:-5], dq[:-5]
    knots, tau, felt = links_of(truth, motion)
    feeling = CubicSpline(knots, felt)
    whole = CubicSpline(grid, np.concatenate([q, dq, CubicSpline(knots, tau)(grid)], axis=1))
    t_s = np.arange(0.0, grid[-1], 1.0 / parts.joints_hz)
    q, dq, tau = np.split(whole(t_s), 3, axis=1)
    dq, tau = dq + 5e-3 * rng.normal(size=q.shape), tau + 0.02 * rng.normal(size=q.shape)
    q = q + parts.q_noise * rng.normal(size=q.shape)
    sensors = {}
    for i in links:
        own = np.arange(0.01 + rng.uniform(0, 0.002), grid[-1] - 0.01, 1.0 / parts.rate_hz)
        late, turn = parts.late_s * rng.uniform(-1, 1), exp_rotation(2 * rng.normal(size=3))
        place = 0.05 * rng.normal(size=3)
        w, dw, a = np.split(feeling(own - late)[:, i], 3, axis=1)
        a = a + np.cross(dw, place) + np.cross(w, np.cross(w, place))
        w_bias, a_bias = (x * rng.uniform(-1, 1, 3) for x in (parts.w_bias, parts.a_bias))
        w = w @ turn + w_bias + parts.w_noise * rng.normal(size=w.shape)
        a = a @ turn + a_bias + parts.a_noise * rng.normal(size=w.shape)
        sensors[i] = own, w, a
    return Glued(truth, t_s, q, dq, tau, sensors)


def axis_errors(
    truth: Truth, R: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Errors of the axes against each other, whatever the frames along them.

    Returns:
        Angle (n - 1,) deg and distance (n - 1,) mm of neighbours, and for each axis between two
        others how far (n - 2,) mm and by which turn (n - 2,) deg the next common normal comes
        after the last (Denavit and Hartenberg's four numbers).
    """
    ours, true = _normals(R, p), _normals(truth.R, truth.p)
    angle, distance, offset, turn = (a - b for a, b in zip(ours, true, strict=True))
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return np.degrees(angle), 1e3 * distance, 1e3 * offset, np.degrees(turn)


def _normals(R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, ...]:
    n, axes, places = len(p), [], []
    turn, at = np.eye(3), np.zeros(3)
    for j in range(n):
        at, turn = at + turn @ p[j], turn @ R[j]
        axes.append(turn[:, 2])
        places.append(at)
    angle, distance, feet, normals = [], [], [], []
    for z, u, o, c in zip(axes, axes[1:], places, places[1:], strict=False):
        normal = np.cross(z, u)
        size = float(np.linalg.norm(normal))
        normal = normal / size
        x, y, d = np.linalg.solve(np.column_stack([z, -u, normal]), c - o)
        angle.append(np.arctan2(size, z @ u))
        distance.append(d)
        feet.append((o + x * z, c + y * u))
        normals.append(normal)
    offset = [(feet[j][0] - feet[j - 1][1]) @ axes[j] for j in range(1, n - 1)]
    turns = [
        np.arctan2(np.cross(a, b) @ z, a @ b)
        for a, b, z in zip(normals, normals[1:], axes[1:], strict=False)
    ]
    return tuple(map(np.array, (angle, distance, offset, turns)))
