"""Definitions (`ros2msg`) of the ROS 2 messages that a recording holds, as MCAP schemas want them.

An MCAP schema of encoding `ros2msg` is the definition of the message followed by those of all
messages it uses, each after a line of 80 `=` and a line `MSG: package/Name`. Field names, types
and order are facts of the public packages builtin_interfaces, std_msgs, geometry_msgs and
sensor_msgs (ROS 2 Humble and later).
"""

from __future__ import annotations

_SEPARATOR = "=" * 80

_FIELDS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Accel": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
}


def _schema(fields: str, uses: tuple[str, ...]) -> str:
    parts = [fields] + [f"MSG: {name}\n{_FIELDS[name]}" for name in uses]
    return f"{_SEPARATOR}\n".join(parts)


_HEADER = ("std_msgs/Header", "builtin_interfaces/Time")

JOINT_STATE = "sensor_msgs/msg/JointState"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ACCEL_STAMPED = "geometry_msgs/msg/AccelStamped"
IMU = "sensor_msgs/msg/Imu"

SCHEMAS = {
    JOINT_STATE: _schema(
        "std_msgs/Header header\n"
        "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
        _HEADER,
    ),
    TWIST_STAMPED: _schema(
        "std_msgs/Header header\ngeometry_msgs/Twist twist\n",
        (*_HEADER, "geometry_msgs/Twist", "geometry_msgs/Vector3"),
    ),
    ACCEL_STAMPED: _schema(
        "std_msgs/Header header\ngeometry_msgs/Accel accel\n",
        (*_HEADER, "geometry_msgs/Accel", "geometry_msgs/Vector3"),
    ),
    IMU: _schema(
        "std_msgs/Header header\n"
        "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
        (*_HEADER, "geometry_msgs/Quaternion", "geometry_msgs/Vector3"),
    ),
}
