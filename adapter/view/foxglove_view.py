"""The run over Foxglove's WebSocket protocol, for Foxglove, Lichtblick, PlotJuggler and the like.

Every topic is a ROS 2 message (CDR, with its definition beside it), the only encoding that all of
them plot; rosbags knows definitions and bytes, Foxglove's own library (extra `live`) does the
rest: who is slow loses the oldest messages.

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
from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from adapter.effects.export import to_urdf
from adapter.errors import MeansError, UsageError
from adapter.gap.monitor_judge import sentence
from adapter.model.spatial import Array, matrix_from_zxz, rot_z
from adapter.model.tree import BASE
from adapter.view.now import KnownRun, Now
from adapter.view.server import HOST

BACKLOG = 64  # messages that wait for a slow client; then the oldest go
DESCRIPTION_S = 2.0  # the description comes again and again: nobody is told what was before
LEARNED = "learned/"  # prefix of the learned arm's frames
JOINT_STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
WRENCH, TEXT, TRANSFORMS = (
    "geometry_msgs/msg/WrenchStamped",
    "std_msgs/msg/String",
    "tf2_msgs/msg/TFMessage",
)
TOPICS = {
    "/joint_states": JOINT_STATE,
    "/residuals": JOINT_STATE,
    "/residual_noise": JOINT_STATE,
    "/external_torques": JOINT_STATE,
    "/external_wrench": WRENCH,
    "/lambda": ARRAY,
    "/lambda_std": ARRAY,
    "/theta": ARRAY,
    "/theta_std": ARRAY,
    "/load": ARRAY,
    "/loop_time": ARRAY,
    "/findings": TEXT,
    "/state": TEXT,
    "/robot_description": TEXT,
    "/tf": TRANSFORMS,
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


class Messages:
    """ROS 2 messages of an arm, as bytes.

    Args:
        joints: names.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._types, self._joints = self._store.types, list(joints)
        self._none = np.zeros(0)

    def definition(self, name: str) -> str:
        """Of a message and of all that it uses (ros2msg)."""
        return str(self._store.generate_msgdef(name, ros_version=2)[0])

    def joint_state(self, stamp_ns: int, q: Array, dq: Array, tau: Array) -> bytes:
        """(n,) each, or none of it (0,)."""
        return self._bytes(JOINT_STATE, self._header(stamp_ns), self._joints, q, dq, tau)

    def effort(self, stamp_ns: int, tau: Array) -> bytes:
        """(n,) torques, N m."""
        return self.joint_state(stamp_ns, self._none, self._none, tau)

    def wrench(self, stamp_ns: int, frame: str, wrench: Array) -> bytes:
        """(6,) [f; m], N and N m."""
        force, torque = (
            self._of("geometry_msgs/msg/Vector3", *part) for part in np.split(wrench, 2)
        )
        both = self._of("geometry_msgs/msg/Wrench", force, torque)
        return self._bytes(WRENCH, self._header(stamp_ns, frame), both)

    def array(self, values: Array, labels: Sequence[str]) -> bytes:
        """Any shape; a label for each dimension."""
        sizes, dims = np.shape(values), []
        for k, (label, size) in enumerate(zip(labels, sizes, strict=True)):
            stride = int(np.prod(sizes[k:]))
            dims.append(self._of("std_msgs/msg/MultiArrayDimension", label, size, stride))
        layout = self._of("std_msgs/msg/MultiArrayLayout", dims, 0)
        return self._bytes(ARRAY, layout, np.ascontiguousarray(values, np.float64).ravel())

    def text(self, words: str) -> bytes:
        """A line."""
        return self._bytes(TEXT, words)

    def transforms(self, stamp_ns: int, frames: Sequence[tuple[str, str, Array, Array]]) -> bytes:
        """Frames: (parent, child, (3, 3) rotation, (3,) shift in m)."""
        from scipy.spatial.transform import Rotation

        found = []
        for parent, child, R, p in frames:
            turn = self._of("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(R).as_quat())
            shift = self._of("geometry_msgs/msg/Vector3", *p)
            both = self._of("geometry_msgs/msg/Transform", shift, turn)
            header = self._header(stamp_ns, parent)
            found.append(self._of("geometry_msgs/msg/TransformStamped", header, child, both))
        return self._bytes(TRANSFORMS, found)

    def _of(self, name: str, *parts: Any) -> Any:
        return self._types[name](*parts)

    def _header(self, stamp_ns: int, frame: str = "") -> Any:
        time = self._of("builtin_interfaces/msg/Time", *divmod(int(stamp_ns), 1_000_000_000))
        return self._of("std_msgs/msg/Header", time, frame)

    def _bytes(self, name: str, *parts: Any) -> bytes:
        return bytes(self._store.serialize_cdr(self._of(name, *parts), name))


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

        arm = known.documented
        self._arm, self._messages = arm, Messages(arm.tree.joint_names)
        self._context = context = foxglove.Context()  # channels end with it
        self._channels = {topic: self._channel(topic, context) for topic in TOPICS}
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
        self._description = self._messages.text(to_urdf(arm))
        self._described_s, self._version = -np.inf, 0
        self._told: set[str] = set()
        self._headline = ""

    def _channel(self, topic: str, context: Any) -> Any:
        import foxglove

        name = TOPICS[topic]
        data = self._messages.definition(name).encode()
        schema = foxglove.Schema(name=name, encoding="ros2msg", data=data)
        return foxglove.Channel(topic, schema=schema, message_encoding="cdr", context=context)

    def __call__(self, now: Now) -> None:
        """Take what is to be seen now; waits for nobody."""
        for topic, data in self._due(now).items():
            self._channels[topic].log(data, log_time=max(now.stamp_ns, 0))
        if now.view.done:
            self._server.stop()

    def _due(self, now: Now) -> dict[str, bytes]:
        made, due, stamp_ns = self._messages, dict[str, bytes](), now.stamp_ns
        if np.isfinite(now.q).all():
            due["/joint_states"] = made.joint_state(stamp_ns, now.q, now.dq, now.tau)
            due["/tf"] = made.transforms(stamp_ns, self._transforms(now))
        if np.isfinite(now.residual).all():
            due["/residuals"] = made.effort(stamp_ns, now.residual)
            due["/residual_noise"] = made.effort(stamp_ns, now.noise)
        push = now.view.push
        if push is not None:
            due["/external_torques"] = made.effort(push.stamp_ns, push.torque)
            base = self._arm.tree.base_name
            due["/external_wrench"] = made.wrench(push.stamp_ns, base, push.wrench)
        return due | self._slow(now) | self._words(now)

    def _slow(self, now: Now) -> dict[str, bytes]:
        """What is said when there is a new estimate, or news."""
        made, due, snapshot = self._messages, dict[str, bytes](), now.view.snapshot
        if snapshot is not None and now.frames is not None and snapshot.version != self._version:
            self._version = snapshot.version
            by_joint = "joint", "turn x y z in rad; shift x y z in m"
            due["/lambda"] = made.array(now.frames.off, by_joint)
            due["/lambda_std"] = made.array(now.frames.off_std, by_joint)
            by_link = "link", "m mX mY mZ XX XY XZ YY YZ ZZ"
            due["/theta"] = made.array(snapshot.theta, by_link)
            due["/theta_std"] = made.array(snapshot.theta_std, by_link)
        if now.load is not None:
            mass = np.array([now.load["m"], now.load["m_std"]])
            due["/load"] = made.array(mass, ("mass and its standard deviation, kg",))
        if now.lately is not None:
            loop = now.lately.of("loop_us")
            shares = np.array([loop.percentile_us(share) or np.nan for share in (50.0, 99.0)])
            due["/loop_time"] = made.array(shares, ("p50 and p99 of the last seconds, us",))
        return due

    def _words(self, now: Now) -> dict[str, bytes]:
        made, due = self._messages, dict[str, bytes]()
        if now.view.elapsed_s - self._described_s > DESCRIPTION_S:
            self._described_s = now.view.elapsed_s
            due["/robot_description"] = self._description
            self._headline = ""  # once more with it, for those who came meanwhile
        if now.headline != self._headline:
            self._headline = now.headline
            due["/state"] = made.text(now.headline)
        for found in now.findings:
            key = f"{found['what']} {found['joints']} {found['since_s']:.3f} {found['over_s']}"
            if key not in self._told:
                self._told.add(key)
                due["/findings"] = made.text(sentence(found, 0.0))
                break  # the next one with the next frame
        return due

    def _transforms(self, now: Now) -> list[tuple[str, str, Array, Array]]:
        arm, tree = self._arm, self._arm.tree
        turned = rot_z(now.q)
        arms = {"": (matrix_from_zxz(arm.lam[:, :3]), arm.lam[:, 3:])}
        found = [(tree.base_name, LEARNED + tree.base_name, np.eye(3), np.zeros(3))]
        if now.frames is not None:
            arms[LEARNED] = now.frames.R, now.frames.p
        for prefix, (R, p) in arms.items():
            for j, i in enumerate(tree.parent):
                parent = tree.base_name if i == BASE else tree.link_names[i]
                child = prefix + tree.link_names[j]
                found.append((prefix + parent, child, R[j] @ turned[j], p[j]))
        return found
