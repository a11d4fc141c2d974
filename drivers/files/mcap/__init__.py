"""Recordings: MCAP files of profile ros2, written and read.

`/joint_states` (sensor_msgs/msg/JointState), `/link_twists/<link>` and `/link_accels/<link>`
(geometry_msgs/msg/TwistStamped and AccelStamped, frame_id the link), `/joint_commands` (JointState
with effort only; of an arm that takes positions, with position only), messages of any other type
that `ros_types.schemas` defines (`/estimates`, `/tf`, `/robot_description`, ...), a metadata record
with configuration and version. Every message is CDR and every channel carries its definition, so
that programs read a recording that have never heard of this one. Read only: sensor_msgs/msg/Imu on
any topic; of a floating base also nav_msgs/msg/Odometry, TwistStamped and AccelStamped on any
topic.
"""

from drivers.files.mcap.bags import is_recording
from drivers.files.mcap.joints import derive_velocity, looks_like_degrees
from drivers.files.mcap.links import READERS, Carrier
from drivers.files.mcap.log import Commands, FrameMotion, Log, mapped, write_log
from drivers.files.mcap.read import (
    IN_MEMORY,
    read_estimates,
    read_log,
    read_messages,
    read_position_log,
    survey,
)
from drivers.files.mcap.recover import recover
from drivers.files.mcap.sampled import sample_log
from drivers.files.mcap.writer import FLUSH_S, JOINT_COMMANDS, McapWriter

__all__ = [
    "FLUSH_S",
    "IN_MEMORY",
    "JOINT_COMMANDS",
    "READERS",
    "Carrier",
    "Commands",
    "FrameMotion",
    "Log",
    "McapWriter",
    "derive_velocity",
    "is_recording",
    "looks_like_degrees",
    "mapped",
    "read_estimates",
    "read_log",
    "read_messages",
    "read_position_log",
    "recover",
    "sample_log",
    "survey",
    "write_log",
]
