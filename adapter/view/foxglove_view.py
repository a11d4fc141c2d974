"""The run over Foxglove's WebSocket protocol, for Foxglove, Lichtblick, PlotJuggler and the like.

Every topic is a ROS 2 message (CDR, with its definition beside it), the only encoding that all of
them plot; Foxglove's own library (extra `live`) does the rest: who is slow loses the oldest
messages.

    /joint_states             sensor_msgs/JointState     q, dq, tau of the filtered state
    /residuals                sensor_msgs/JointState     effort: what the estimate does not explain
    /residual_noise           sensor_msgs/JointState     effort: its standard deviation so far
    /external_torques         sensor_msgs/JointState     effort: what the surroundings push with
    /external_wrench          geometry_msgs/WrenchStamped  on the last link, axes of the base
    /lambda, /lambda_std      std_msgs/Float64MultiArray (n, 6): [turn; shift] off the documentation
    /theta, /theta_std        std_msgs/Float64MultiArray (n, 10)
    /load                     std_msgs/Float64MultiArray mass and its standard deviation, kg
    /loop_time                std_msgs/Float64MultiArray p50 and p99 of the last seconds, µs
    /findings                 std_msgs/String            each finding once, as a sentence
    /state                    std_msgs/String            the headline, where it changes
    /robot_description        std_msgs/String            URDF of the documented arm
    /tf                       tf2_msgs/TFMessage         the documented arm, and under learned/ ours
"""

from __future__ import annotations

import importlib.util
import socket
from itertools import islice
from typing import Any

import numpy as np

from adapter.effects.robots import to_urdf
from adapter.errors import MeansError, UsageError
from adapter.gap.monitor_judge import sentence
from adapter.model.inertia import PARAMETERS
from adapter.model.spatial import Array, at_joints, matrix_from_zxz, quaternion_from_matrix
from adapter.realtime.run_messages import table_fields, wrench_fields, xyz
from adapter.view.now import KnownRun, Now, untold
from adapter.view.server import HOST
from drivers.files.messages import Fields, encode, header
from drivers.files.ros_types import (
    FLOAT64_MULTI_ARRAY,
    JOINT_STATE,
    STRING,
    TF,
    WRENCH_STAMPED,
    schemas,
)

BACKLOG = 64  # messages that wait for a slow client; then the oldest go
DESCRIPTION_S = 2.0  # the description comes again and again: nobody is told what was before
LEARNED = "learned/"  # prefix of the learned arm's frames
NONE: Array = np.zeros(0)
TOPICS = {
    "/joint_states": JOINT_STATE,
    "/residuals": JOINT_STATE,
    "/residual_noise": JOINT_STATE,
    "/external_torques": JOINT_STATE,
    "/external_wrench": WRENCH_STAMPED,
    "/lambda": FLOAT64_MULTI_ARRAY,
    "/lambda_std": FLOAT64_MULTI_ARRAY,
    "/theta": FLOAT64_MULTI_ARRAY,
    "/theta_std": FLOAT64_MULTI_ARRAY,
    "/load": FLOAT64_MULTI_ARRAY,
    "/loop_time": FLOAT64_MULTI_ARRAY,
    "/findings": STRING,
    "/state": STRING,
    "/robot_description": STRING,
    "/tf": TF,
}


def need_foxglove() -> None:
    """Raises MeansError where Foxglove's library is missing."""
    if importlib.util.find_spec("foxglove") is None:
        raise MeansError("--foxglove needs foxglove-sdk: pip install 'panda-adapter[live]'")


def free_port(port: int) -> int:
    """The port, or any free one for 0. Raises UsageError where it is taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise UsageError(
                f"nothing can be served to Foxglove on port {port} ({error.strerror}); choose "
                "another: --foxglove PORT, or --foxglove 0 for any that is free"
            ) from None
        return int(probe.getsockname()[1])


class FoxgloveView:
    """Serves and feeds them; stamps are the arm's own.

    Args:
        known: the run.
        port: on this machine.

    Raises:
        MeansError: the port is taken, or the library is missing.
    """

    def __init__(self, known: KnownRun, port: int) -> None:
        need_foxglove()
        import foxglove

        arm = self._arm = known.documented
        self._context = context = foxglove.Context()  # channels end with it
        self._channels: dict[str, Any] = {}
        for topic, name in TOPICS.items():
            data = schemas()[name].encode()
            schema = foxglove.Schema(name=name, encoding="ros2msg", data=data)
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=context
            )
        try:
            self._server = foxglove.start_server(
                name=f"panda-adapter, {arm.name}",
                host=HOST,
                port=port,
                context=context,
                session_id=known.key or None,
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError) as error:
            raise MeansError(f"nothing can be served on port {port}: {error}") from None
        self._description = {"data": to_urdf(arm)}
        self._described_s, self._version = -np.inf, 0
        self._told: set[str] = set()
        self._headline = ""

    def __call__(self, now: Now) -> None:
        """Take what is to be seen now; waits for nobody."""
        for topic, fields in self._due(now).items():
            data = encode(TOPICS[topic], fields)
            self._channels[topic].log(data, log_time=max(now.stamp_ns, 0))
        if now.view.done:
            self._server.stop()

    def _due(self, now: Now) -> dict[str, Fields]:
        due, stamp_ns = dict[str, Fields](), now.stamp_ns
        if np.isfinite(now.q).all():
            due["/joint_states"] = self._joints(stamp_ns, now.tau, now.q, now.dq)
            due["/tf"] = {"transforms": self._transforms(now)}
        if np.isfinite(now.residual).all():
            due["/residuals"] = self._joints(stamp_ns, now.residual)
            due["/residual_noise"] = self._joints(stamp_ns, now.noise)
        push = now.view.push
        if push is not None:
            due["/external_torques"] = self._joints(push.stamp_ns, push.torque)
            base, wrench = self._arm.tree.base_name, push.wrench.reshape(2, 3)
            due["/external_wrench"] = wrench_fields(push.stamp_ns, base, wrench)
        return due | self._slow(now)

    def _joints(self, stamp_ns: int, tau: Array, q: Array = NONE, dq: Array = NONE) -> Fields:
        """Torques (n,) N m, where they are told with q and dq (n,) rad and rad/s."""
        signals = {"position": q, "velocity": dq, "effort": tau}
        return {"header": header(stamp_ns), "name": self._arm.tree.joint_names, **signals}

    def _slow(self, now: Now) -> dict[str, Fields]:
        """What is said when there is a new estimate, or news; and words, now and then."""
        due, snapshot = dict[str, Fields](), now.view.snapshot
        if snapshot is not None and now.frames is not None and snapshot.version != self._version:
            self._version = snapshot.version
            by_joint = "joint", "turn x y z in rad; shift x y z in m"
            due["/lambda"] = table_fields(by_joint, now.frames.off)
            due["/lambda_std"] = table_fields(by_joint, now.frames.off_std)
            by_link = "link", " ".join(PARAMETERS)
            due["/theta"] = table_fields(by_link, snapshot.theta)
            due["/theta_std"] = table_fields(by_link, snapshot.theta_std)
        if now.load is not None:
            mass = np.array([now.load["m"], now.load["m_std"]])
            due["/load"] = table_fields(("mass and its standard deviation, kg",), mass)
        if now.lately is not None:
            loop = now.lately.of("loop_us")
            shares = np.array([loop.percentile_us(share) or np.nan for share in (50.0, 99.0)])
            due["/loop_time"] = table_fields(("p50 and p99 of the last seconds, us",), shares)
        if now.view.elapsed_s - self._described_s > DESCRIPTION_S:
            self._described_s = now.view.elapsed_s
            due["/robot_description"] = self._description
            self._headline = ""  # once more with it, for those who came meanwhile
        if now.headline != self._headline:
            self._headline = now.headline
            due["/state"] = {"data": now.headline}
        for found in islice(untold(now.findings, self._told), 1):  # the next with the next frame
            due["/findings"] = {"data": sentence(found, 0.0)}
        return due

    def _transforms(self, now: Now) -> list[Fields]:
        tree, lam = self._arm.tree, self._arm.lam
        same = np.eye(3)[None], np.zeros((1, 3))
        found = [([tree.base_name], [LEARNED + tree.base_name], *same)]
        arms = {"": (matrix_from_zxz(lam[:, :3]), lam[:, 3:])}
        if now.frames is not None:
            arms[LEARNED] = now.frames.R, now.frames.p
        for prefix, (R, p) in arms.items():
            names = [prefix + name for name in (*tree.link_names, tree.base_name)]  # BASE: the last
            placed = at_joints(R, p, now.q, tree.slides)
            found.append(([names[i] for i in tree.parent], names[:-1], *placed))
        return [
            {
                "header": header(now.stamp_ns, parent),
                "child_frame_id": child,
                "transform": {
                    "translation": xyz(place),
                    "rotation": dict(zip("wxyz", quaternion.tolist(), strict=True)),
                },
            }
            for parents, children, R, p in found
            for parent, child, quaternion, place in zip(
                parents, children, quaternion_from_matrix(R), p, strict=True
            )
        ]
