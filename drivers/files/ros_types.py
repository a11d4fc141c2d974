"""Types of the ROS 2 messages in a recording, and their definitions in the format `ros2msg`.

The public packages' are those of the library `rosbags` (ROS 2 Humble). `panda_adapter_msgs` is our
own: numbers that no public message has a name for.
"""

from __future__ import annotations

from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ACCEL_STAMPED = "geometry_msgs/msg/AccelStamped"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
DYNAMIC_JOINT_STATE = "control_msgs/msg/DynamicJointState"
JOINT_TRAJECTORY_CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
JOINT_JOG = "control_msgs/msg/JointJog"
FRANKA_ROBOT_STATE = "franka_msgs/msg/FrankaRobotState"
FRANKA_STATE = "franka_msgs/msg/FrankaState"  # of ROS 2; that of ROS 1 comes with its definition
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
STRING = "std_msgs/msg/String"
FLOAT64_MULTI_ARRAY = "std_msgs/msg/Float64MultiArray"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
ESTIMATE = "panda_adapter_msgs/msg/Estimate"
LOAD = "panda_adapter_msgs/msg/Load"
TIMING = "panda_adapter_msgs/msg/Timing"

LAMBDA_FIELDS = ("alpha", "beta", "gamma", "px", "py", "pz")  # eq. 3b
OFFSET_FIELDS = ("rx", "ry", "rz", "x", "y", "z")  # of a frame off the documented one, rad and m
THETA_FIELDS = ("m", "mx", "my", "mz", "ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # eq. 4b
SHARE_FIELDS = ("p50", "p99", "p99_9", "max")
TIMES = ("tick", "loop", "plant", "lateness", "period", "age")


def _doubles(names: tuple[str, ...]) -> str:
    return "".join(f"float64 {name}\n" for name in names)


_OWN = {
    "panda_adapter_msgs/Lambda": _doubles(LAMBDA_FIELDS),
    "panda_adapter_msgs/Offset": _doubles(OFFSET_FIELDS),
    "panda_adapter_msgs/Theta": _doubles(THETA_FIELDS),
    "panda_adapter_msgs/JointEstimate": "string name\npanda_adapter_msgs/Lambda value\n"
    "panda_adapter_msgs/Lambda std\npanda_adapter_msgs/Offset off\nfloat64 torque_std\n",
    "panda_adapter_msgs/BodyEstimate": "string name\npanda_adapter_msgs/Theta value\n"
    "panda_adapter_msgs/Theta std\n",
    "panda_adapter_msgs/EffectEstimate": "string effect\nstring joint\nfloat64 value\n"
    "float64 std\nfloat64 shape\n",
    "panda_adapter_msgs/Estimate": "std_msgs/Header header\nuint64 learned\n"
    "string lambda_source\nbool lambda_converged\nbool theta_converged\n"
    "panda_adapter_msgs/JointEstimate[] joints\npanda_adapter_msgs/BodyEstimate[] bodies\n"
    "panda_adapter_msgs/EffectEstimate[] effects\n",
    "panda_adapter_msgs/Load": "std_msgs/Header header\nfloat64 mass\nfloat64 mass_std\n"
    "geometry_msgs/Vector3 com\n",
    "panda_adapter_msgs/Shares": _doubles(SHARE_FIELDS),
    "panda_adapter_msgs/Timing": "std_msgs/Header header\nuint64 ticks\n"
    "uint64 missed_deadlines\nuint64 missed_own\n"
    + "".join(f"panda_adapter_msgs/Shares {what}_us\n" for what in TIMES),
}


@cache
def schemas() -> dict[str, str]:
    """By type what a channel of an MCAP carries; the library takes 0.1 s to load its own.

    It is the definition of the message, followed by those of all messages it uses, each after a
    line of 80 `=` and a line `MSG: package/Name`. A program that has never heard of a type reads it
    with this text alone.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _OWN.items():
        store.register(get_types_from_msg(text, name.replace("/", "/msg/")))
    types = (
        *(JOINT_STATE, JOINT_TRAJECTORY, TWIST_STAMPED, ACCEL_STAMPED, WRENCH_STAMPED, IMU),
        *(ODOMETRY, STRING, FLOAT64_MULTI_ARRAY, TF, DIAGNOSTICS, ESTIMATE, LOAD, TIMING),
    )
    return {name: store.generate_msgdef(name, ros_version=2)[0] for name in types}
