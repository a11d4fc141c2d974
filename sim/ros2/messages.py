"""The four messages that the arm speaks, as IDL of the library; names and layout are ROS 2's."""

from __future__ import annotations

from cyclonedds.idl import make_idl_struct, types

Time = make_idl_struct(
    "Time_",
    "builtin_interfaces.msg.dds_.Time_",
    {"sec": types.int32, "nanosec": types.uint32},
)
Header = make_idl_struct("Header_", "std_msgs.msg.dds_.Header_", {"stamp": Time, "frame_id": str})
JointState = make_idl_struct(
    "JointState_",
    "sensor_msgs.msg.dds_.JointState_",
    {
        "header": Header,
        "name": types.sequence[str],
        "position": types.sequence[types.float64],
        "velocity": types.sequence[types.float64],
        "effort": types.sequence[types.float64],
    },
)
Dimension = make_idl_struct(
    "MultiArrayDimension_",
    "std_msgs.msg.dds_.MultiArrayDimension_",
    {"label": str, "size": types.uint32, "stride": types.uint32},
)
Layout = make_idl_struct(
    "MultiArrayLayout_",
    "std_msgs.msg.dds_.MultiArrayLayout_",
    {"dim": types.sequence[Dimension], "data_offset": types.uint32},
)
Float64MultiArray = make_idl_struct(
    "Float64MultiArray_",
    "std_msgs.msg.dds_.Float64MultiArray_",
    {"layout": Layout, "data": types.sequence[types.float64]},
)
String = make_idl_struct("String_", "std_msgs.msg.dds_.String_", {"data": str})
