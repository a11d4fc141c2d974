"""Definitions of the ROS 2 messages in a recording, as the format `ros2msg` wants them.

`SCHEMAS` holds by type what a channel of an MCAP carries: the definition of the message, followed
by those of all messages it uses, each after a line of 80 `=` and a line `MSG: package/Name`. A
program that has never heard of a type reads it with this text alone. Field names, types and order
are facts of the public packages builtin_interfaces, std_msgs, geometry_msgs, nav_msgs,
sensor_msgs, trajectory_msgs, tf2_msgs and diagnostic_msgs (ROS 2 Humble and later).

`panda_adapter_msgs` is our own: numbers that no public message has a name for.
"""

from __future__ import annotations

import re

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ACCEL_STAMPED = "geometry_msgs/msg/AccelStamped"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
DYNAMIC_JOINT_STATE = "control_msgs/msg/DynamicJointState"
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
THETA_FIELDS = ("m", "mx", "my", "mz", "ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # eq. 4b
SHARE_FIELDS = ("p50", "p99", "p99_9", "max")
TIMES = ("tick", "loop", "plant", "lateness", "period", "age")

_SEPARATOR = "=" * 80
_USED = re.compile(r"^(\w+/\w+)(?:\[\d*\])? ", re.MULTILINE)
_TWIST = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
_XYZ = "float64 x\nfloat64 y\nfloat64 z\n"


def _doubles(names: tuple[str, ...]) -> str:
    return "".join(f"float64 {name}\n" for name in names)


_FIELDS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/String": "string data\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/Float64MultiArray": "std_msgs/MultiArrayLayout layout\nfloat64[] data\n",
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Quaternion": _XYZ + "float64 w\n",
    "geometry_msgs/Twist": _TWIST,
    "geometry_msgs/Accel": _TWIST,
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform\n",
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist\n",
    "geometry_msgs/AccelStamped": "std_msgs/Header header\ngeometry_msgs/Accel accel\n",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "trajectory_msgs/JointTrajectoryPoint": "float64[] positions\nfloat64[] velocities\n"
    "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start\n",
    "trajectory_msgs/JointTrajectory": "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/JointTrajectoryPoint[] points\n",
    "sensor_msgs/JointState": "std_msgs/Header header\n"
    "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
    "sensor_msgs/Imu": "std_msgs/Header header\n"
    "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
    "nav_msgs/Odometry": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
    "diagnostic_msgs/KeyValue": "string key\nstring value\n",
    "diagnostic_msgs/DiagnosticStatus": "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n"
    "byte level\nstring name\nstring message\nstring hardware_id\n"
    "diagnostic_msgs/KeyValue[] values\n",
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\n"
    "diagnostic_msgs/DiagnosticStatus[] status\n",
    "panda_adapter_msgs/Lambda": _doubles(LAMBDA_FIELDS),
    "panda_adapter_msgs/Theta": _doubles(THETA_FIELDS),
    "panda_adapter_msgs/JointEstimate": "string name\npanda_adapter_msgs/Lambda value\n"
    "panda_adapter_msgs/Lambda std\nfloat64 torque_std\n",
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


def _used_by(name: str, found: list[str]) -> list[str]:
    """Messages that a message has in it, and those that these have, once each."""
    for used in _USED.findall(_FIELDS[name]):
        if used not in found:
            found.append(used)
            _used_by(used, found)
    return found


def _schema(name: str) -> str:
    package, _, short = name.split("/")
    own = f"{package}/{short}"
    parts = [_FIELDS[own], *(f"MSG: {used}\n{_FIELDS[used]}" for used in _used_by(own, []))]
    return f"{_SEPARATOR}\n".join(parts)


SCHEMAS = {
    name: _schema(name)
    for name in (
        *(JOINT_STATE, JOINT_TRAJECTORY, TWIST_STAMPED, ACCEL_STAMPED, WRENCH_STAMPED, IMU),
        *(ODOMETRY, STRING, FLOAT64_MULTI_ARRAY, TF, DIAGNOSTICS, ESTIMATE, LOAD, TIMING),
    )
}
