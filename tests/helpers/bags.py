"""Bags of ROS 1 and rosbag2 with messages of joints, written by `rosbags`."""

from dataclasses import dataclass

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
JOINTS = ("arm_joint1", "arm_joint2", "arm_joint3")
_ROBOT_STATE = """std_msgs/Header header
franka_msgs/CollisionIndicators collision_indicators
sensor_msgs/JointState measured_joint_state
sensor_msgs/JointState desired_joint_state
float64[7] ddq_d
float64 time
"""
_COLLISION = "".join(f"geometry_msgs/Vector3 {x}\n" for x in "abcd")
_OTHERS = ("q_d", "dq_d", "ddq_d", "theta", "dtheta", "dtau_j")
_ORDER = ("q", "q_d", "dq", "dq_d", "ddq_d", "theta", "dtheta", "tau_j", "dtau_j")
_FIXED = "".join(f"float64[7] {x}\n" for x in _ORDER)
DEFINITIONS = {
    "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    "control_msgs/msg/DynamicJointState": (
        "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n"
    ),
    "control_msgs/msg/JointJog": (
        "std_msgs/Header header\nstring[] joint_names\nfloat64[] displacements\n"
        "float64[] velocities\nfloat64 duration\n"
    ),
    "franka_msgs/msg/CollisionIndicators": f"{_COLLISION}float64[7] e\nfloat64[7] f\n",
    "franka_msgs/msg/FrankaRobotState": _ROBOT_STATE,
    "franka_msgs/msg/FrankaState": (
        f"std_msgs/Header header\nfloat64[6] a\nfloat64[6] b\n{_FIXED}float64 time\n"
    ),
}
_ROS1_STATE = """std_msgs/Header header
float64[7] tau_J
float64 time
float64[7] dq
float64[7] q
"""


def _store(kind, definitions):
    store = get_typestore(kind)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    return store


ROS1 = _store(Stores.ROS1_NOETIC, {"franka_msgs/msg/FrankaState": _ROS1_STATE})
ROS2 = _store(Stores.ROS2_HUMBLE, DEFINITIONS)


@dataclass(frozen=True)
class Motion:
    """Stamps (m,) ns and signals (m, n) of joints; a controller's goals, and efforts if numbers."""

    stamp_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    goal: np.ndarray | None = None

    @classmethod
    def of(cls, joints=3, samples=60, period_ns=10_000_000, seed=1):
        rng = np.random.default_rng(seed)
        t = np.arange(samples) * period_ns * 1e-9
        speed, size = rng.uniform(1, 3, joints), rng.uniform(0.2, 0.8, joints)
        q = size * np.sin(np.outer(t, speed))
        dq = size * speed * np.cos(np.outer(t, speed))
        tau = 9.0 * np.cos(q) + rng.normal(0, 0.05, q.shape)
        return cls(10**18 + np.arange(samples) * period_ns, q, dq, tau)


def _header(store, stamp_ns, seq):
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(int(stamp_ns), 10**9))
    kind = store.types["std_msgs/msg/Header"]
    more = {"seq": seq} if "seq" in kind.__dataclass_fields__ else {}
    return kind(stamp=stamp, frame_id="base", **more)


def joint_state(store, header, names, q, dq, tau):
    kind = store.types["sensor_msgs/msg/JointState"]
    return kind(header=header, name=list(names), position=q, velocity=dq, effort=tau)


def message(store, kind, names, motion, i):
    """Sample i as a message of a type; what the type has beside it is made up."""
    header = _header(store, motion.stamp_ns[i], i)
    q, dq, tau = motion.q[i], motion.dq[i], motion.tau[i]
    make, filler = store.types[kind], np.full(7, 0.1 * i)
    if kind == "sensor_msgs/msg/JointState":
        return joint_state(store, header, names, q, dq, tau)
    if kind == "control_msgs/msg/DynamicJointState":
        value = store.types["control_msgs/msg/InterfaceValue"]
        order = ["effort", "temperature", "position", "velocity"]
        rows = [
            value(order, np.array([c, 40.0 + i, a, b])) for a, b, c in zip(q, dq, tau, strict=True)
        ]
        sensor = value(["force.x"], np.array([1.0 * i]))
        return make(header, ["wrist_sensor", *names], [sensor, *rows])
    if kind == CONTROLLER_STATE:
        point = store.types["trajectory_msgs/msg/JointTrajectoryPoint"]
        after, none = store.types["builtin_interfaces/msg/Duration"], np.zeros(0)
        # some references have accelerations, and all come at times of their own
        reference = point(motion.goal[i], dq, none if i % 3 else dq, none, after(i, 7 * i))
        feedback = point(q, dq, none, none if np.isnan(tau).all() else tau, after(0, 0))
        rest = [point(none, none, none, none, after(0, 0))] * (len(store.fielddefs[kind][1]) - 4)
        return make(header, list(names), reference, feedback, *rest)
    if kind == "control_msgs/msg/JointJog":
        return make(header, list(names), np.zeros(0), dq, 0.1)
    if kind == "franka_msgs/msg/FrankaRobotState":
        corner = store.types["geometry_msgs/msg/Vector3"](i, 0.0, 0.0)
        flags = store.types["franka_msgs/msg/CollisionIndicators"](*[corner] * 4, filler, filler)
        measured = joint_state(store, header, names, q, dq, tau)
        desired = joint_state(store, header, names, q + 1, dq, tau)
        return make(header, flags, measured, desired, filler, float(i))
    if store is ROS1:
        return make(header, tau, float(i), dq, q)
    arrays = dict.fromkeys(_OTHERS, filler)
    return make(header, filler[:6], filler[:6], q=q, dq=dq, tau_j=tau, time=1.0, **arrays)


def write_ros1(path, topics, names=JOINTS, compression=None):
    """A bag of ROS 1; topics: name -> (type, Motion)."""
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    with writer:
        _fill(writer, ROS1, topics, names, ROS1.serialize_ros1)
    return path


def write_ros2(path, topics, names=JOINTS, storage=None, compression=None):
    """A folder of rosbag2; topics as above; storage and compression of rosbags' writer."""
    writer = Ros2Writer(path, version=9, **({"storage_plugin": storage} if storage else {}))
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        _fill(writer, ROS2, topics, names, ROS2.serialize_cdr)
    return path


def write_ros1_mcap(path, topics, names=JOINTS, definition=None):
    """An MCAP file of messages of ROS 1, as `mcap convert` makes it of a bag; topics as above.

    `definition` is told in place of each type's own.
    """
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=2**12)
        writer.start(profile="ros1")
        for topic, (kind, motion) in topics.items():
            text = definition or ROS1.generate_msgdef(kind)[0]
            schema = writer.register_schema(kind.replace("/msg/", "/"), "ros1msg", text.encode())
            channel = writer.register_channel(topic, "ros1", schema)
            for i, stamp_ns in enumerate(motion.stamp_ns.tolist()):
                raw = bytes(ROS1.serialize_ros1(message(ROS1, kind, names, motion, i), kind))
                writer.add_message(channel, stamp_ns, raw, stamp_ns, i)
        writer.finish()
    return path


def _fill(writer, store, topics, names, serialize):
    for topic, (kind, motion) in topics.items():
        connection = writer.add_connection(topic, kind, typestore=store)
        for i, stamp_ns in enumerate(motion.stamp_ns):
            raw = serialize(message(store, kind, names, motion, i), kind)
            writer.write(connection, int(stamp_ns), raw)


def write_controller_states(path, points, motion, topics=("/arm/state",)):
    """A bag of the kind that the path ends with; `points` are what the message calls its own."""
    ros1, kind = path.suffix == ".bag", CONTROLLER_STATE
    text = "std_msgs/Header header\nstring[] joint_names\n"
    text += "".join(f"trajectory_msgs/JointTrajectoryPoint {name}\n" for name in points)
    store = _store(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE, {kind: text})
    storage = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    writer = Ros1Writer(path) if ros1 else Ros2Writer(path, version=9, storage_plugin=storage)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        _fill(writer, store, dict.fromkeys(topics, (kind, motion)), JOINTS, serialize)
    return path
