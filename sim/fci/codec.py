"""Bytes on the wire: requests and replies over TCP, states and commands over UDP, their codes.

Both datagrams are little-endian and packed. Between message id and modes a RobotState is one run
of floats (f64 in version 5, f32 in version 10), so that the order of the fields is all.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

import numpy as np
from numpy.typing import NDArray

from sim.effects import Array

VERSIONS = (5, 10)
JOINTS = 7
TICK_S = 1e-3  # a state per tick
HOST = "127.0.0.1"
PORT = 1337  # clients know no other
Floats = NDArray[np.floating]
Bytes = NDArray[np.uint8]

# Name and count of the floats of a RobotState, in order.
FIELDS = (
    ("O_T_EE", 16), ("O_T_EE_d", 16), ("F_T_EE", 16), ("EE_T_K", 16), ("F_T_NE", 16),
    ("NE_T_EE", 16), ("m_ee", 1), ("I_ee", 9), ("F_x_Cee", 3), ("m_load", 1), ("I_load", 9),
    ("F_x_Cload", 3), ("elbow", 2), ("elbow_d", 2), ("tau_J", 7), ("tau_J_d", 7), ("dtau_J", 7),
    ("q", 7), ("q_d", 7), ("dq", 7), ("dq_d", 7), ("ddq_d", 7), ("joint_contact", 7),
    ("cartesian_contact", 6), ("joint_collision", 7), ("cartesian_collision", 6),
    ("tau_ext_hat_filtered", 7), ("O_F_ext_hat_K", 6), ("K_F_ext_hat_K", 6), ("O_dP_EE_d", 6),
    ("O_ddP_O", 3), ("elbow_c", 2), ("delbow_c", 2), ("ddelbow_c", 2), ("O_T_EE_c", 16),
    ("O_dP_EE_c", 6), ("O_ddP_EE_c", 6), ("theta", 7), ("dtheta", 7),
)  # fmt: skip

ERRORS = (
    "joint_position_limits_violation", "cartesian_position_limits_violation",
    "self_collision_avoidance_violation", "joint_velocity_violation",
    "cartesian_velocity_violation", "force_control_safety_violation", "joint_reflex",
    "cartesian_reflex", "max_goal_pose_deviation_violation", "max_path_pose_deviation_violation",
    "cartesian_velocity_profile_safety_violation",
    "joint_position_motion_generator_start_pose_invalid",
    "joint_motion_generator_position_limits_violation",
    "joint_motion_generator_velocity_limits_violation",
    "joint_motion_generator_velocity_discontinuity",
    "joint_motion_generator_acceleration_discontinuity",
    "cartesian_position_motion_generator_start_pose_invalid",
    "cartesian_motion_generator_elbow_limit_violation",
    "cartesian_motion_generator_velocity_limits_violation",
    "cartesian_motion_generator_velocity_discontinuity",
    "cartesian_motion_generator_acceleration_discontinuity",
    "cartesian_motion_generator_elbow_sign_inconsistent",
    "cartesian_motion_generator_start_elbow_invalid",
    "force_controller_desired_force_tolerance_violation", "start_elbow_sign_inconsistent",
    "communication_constraints_violation", "power_limit_violation",
    "cartesian_motion_generator_joint_position_limits_violation",
    "cartesian_motion_generator_joint_velocity_limits_violation",
    "cartesian_motion_generator_joint_velocity_discontinuity",
    "cartesian_motion_generator_joint_acceleration_discontinuity",
    "cartesian_position_motion_generator_invalid_frame_flag",
    "controller_torque_discontinuity", "joint_p2p_insufficient_torque_for_planning",
    "tau_J_range_violation", "instability_detected", "joint_move_in_wrong_direction",
    "cartesian_spline_motion_generator_violation",
    "joint_via_motion_generator_planning_joint_limit_violation",
    "base_acceleration_initialization_timeout", "base_acceleration_invalid_reading",
)  # fmt: skip
COMMAND_BYTES = {5: 370, 10: 371}
_Q_AT, _DQ_AT, _POSE_AT, _TWIST_AT, _ELBOW_AT, _ELBOW_VALID = 8, 64, 120, 248, 296, 312
_GENERATOR_END, _TAU_AT, _TORQUE_END = 313, 314, 370
HEADER = struct.Struct("<III")  # command, command id, size with this header
LONGEST = 428  # bytes, SetCollisionBehavior
_CONNECT = struct.Struct("<HH")  # version, UDP port of the client
NAMES = {
    5: (
        "Connect", "Move", "StopMove", "GetCartesianLimit", "SetCollisionBehavior",
        "SetJointImpedance", "SetCartesianImpedance", "SetGuidingMode", "SetEEToK", "SetNEToEE",
        "SetLoad", "SetFilters", "AutomaticErrorRecovery", "LoadModelLibrary",
    ),
    10: (
        "Connect", "Move", "StopMove", "SetCollisionBehavior", "SetJointImpedance",
        "SetCartesianImpedance", "SetGuidingMode", "SetEEToK", "SetNEToEE", "SetLoad",
        "AutomaticErrorRecovery", "GetRobotModel",
    ),
}  # fmt: skip
# Bytes of a request after its header; Move has 113 in version 10.
SIZES = {
    "Connect": 4, "Move": 56, "StopMove": 0, "GetCartesianLimit": 4, "SetCollisionBehavior": 416,
    "SetJointImpedance": 56, "SetCartesianImpedance": 48, "SetGuidingMode": 7, "SetEEToK": 128,
    "SetNEToEE": 128, "SetLoad": 104, "SetFilters": 40, "AutomaticErrorRecovery": 0,
    "LoadModelLibrary": 2, "GetRobotModel": 0,
}  # fmt: skip
LIMIT_REPLY = 153  # zero bytes after the status in GetCartesianLimit's reply: no limit is active


class RobotMode(IntEnum):
    """What the robot does, as the state says it."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERY = 6


class ControllerMode(IntEnum):
    """Controller mode, alike in Move and in the state; OTHER stands for no motion."""

    JOINT_IMPEDANCE = 0
    CARTESIAN_IMPEDANCE = 1
    EXTERNAL = 2
    OTHER = 3


class Generator(IntEnum):
    """Motion generator as Move asks for it; the state says one more, and 0 for no motion."""

    JOINT_POSITION = 0
    JOINT_VELOCITY = 1
    CARTESIAN_POSITION = 2
    CARTESIAN_VELOCITY = 3
    NONE = 4  # version 10 only: torques alone


class StateFrame:
    """A RobotState to be filled in place and sent as it stands.

    Attributes:
        data: the datagram's bytes.
        fields: name -> writable view of the floats.
        errors: (41,) writable flags, 0 or 1.
        reflex_reason: (41,) the same for what ended the last motion.
    """

    def __init__(self, version: int) -> None:
        if version not in VERSIONS:
            raise ValueError(f"no protocol {version}; have: 5, 10")
        kind = np.dtype("<f8" if version == 5 else "<f4")
        more = ("accelerometer_top", 18), ("accelerometer_bottom", 18)
        listed = FIELDS if version == 5 else FIELDS + more
        total = sum(count for _, count in listed)
        self._modes = 8 + total * kind.itemsize
        self._rate = struct.Struct("<d" if version == 5 else "<f")
        self.data = bytearray(self._modes + 2 + 2 * len(ERRORS) + 1 + self._rate.size)
        floats = np.frombuffer(self.data, kind, total, 8)
        self.fields: dict[str, Floats] = {}
        at = 0
        for name, count in listed:
            self.fields[name] = floats[at : at + count]
            at += count
        flags = np.frombuffer(self.data, np.uint8, 2 * len(ERRORS), self._modes + 2)
        self.errors: Bytes = flags[: len(ERRORS)]
        self.reflex_reason: Bytes = flags[len(ERRORS) :]

    def set_id(self, message_id: int) -> None:
        """Write the tick counter."""
        struct.pack_into("<Q", self.data, 0, message_id)

    def set_modes(self, generator: int, controller: int, robot: int, success_rate: float) -> None:
        """Write the modes as the state says them, and the share of commands received."""
        self.data[self._modes] = generator
        self.data[self._modes + 1] = controller
        end = self._modes + 2 + 2 * len(ERRORS)
        self.data[end] = robot
        self._rate.pack_into(self.data, end + 1, success_rate)


@dataclass(frozen=True, slots=True)
class RobotCommand:
    """What a client answered to a state.

    Attributes:
        message_id: of the state answered.
        q: (7,) joint positions, rad.
        dq: (7,) joint velocities, rad/s.
        tau: (7,) torques without gravity, N m.
        generator_finished: the finish flag of motions with a generator (all in version 5).
        torque_finished: the finish flag of torques alone (version 10).
        pose: (16,) of the end effector, column by column.
        twist: (6,) of the end effector, base axes.
        elbow: (2,) joint 3 (rad) and the side of joint 4; None where the client leaves it open.
    """

    message_id: int
    q: Array
    dq: Array
    tau: Array
    generator_finished: bool
    torque_finished: bool
    pose: Array = field(default_factory=lambda: np.zeros(16))
    twist: Array = field(default_factory=lambda: np.zeros(6))
    elbow: Array | None = None


def read_command(data: bytes | bytearray | memoryview, version: int) -> RobotCommand | None:
    """A RobotCommand; None for a datagram of another size."""
    if len(data) != COMMAND_BYTES[version]:
        return None
    return RobotCommand(
        struct.unpack_from("<Q", data)[0],
        np.frombuffer(data, "<f8", JOINTS, _Q_AT),
        np.frombuffer(data, "<f8", JOINTS, _DQ_AT),
        np.frombuffer(data, "<f8", JOINTS, _TAU_AT),
        data[_GENERATOR_END] != 0,
        version == 10 and data[_TORQUE_END] != 0,
        np.frombuffer(data, "<f8", 16, _POSE_AT),
        np.frombuffer(data, "<f8", 6, _TWIST_AT),
        np.frombuffer(data, "<f8", 2, _ELBOW_AT) if data[_ELBOW_VALID] else None,
    )


class Status(StrEnum):
    """What a reply says; each has another number in each version and for each request."""

    OK = "ok"
    NOT_POSSIBLE = "not possible"
    INVALID = "invalid argument"
    STARTED = "motion started"
    PREEMPTED = "preempted"
    REFLEX = "reflex"
    EMERGENCY = "emergency"
    INPUT_ERROR = "input error"
    ABORTED = "aborted"
    MANUAL = "manual recovery required"
    INCOMPATIBLE = "incompatible"
    ERROR = "error"


# Request -> status -> number in version 5 and in version 10.
_CODES: dict[str, dict[Status, tuple[int, int]]] = {
    "Move": {
        Status.OK: (0, 0),
        Status.STARTED: (1, 1),
        Status.PREEMPTED: (2, 2),
        Status.NOT_POSSIBLE: (3, 5),
        Status.INVALID: (5, 7),
        Status.REFLEX: (6, 8),
        Status.EMERGENCY: (7, 9),
        Status.INPUT_ERROR: (8, 10),
        Status.ABORTED: (9, 11),
    },
    "StopMove": {
        Status.OK: (0, 0),
        Status.NOT_POSSIBLE: (1, 1),
        Status.EMERGENCY: (2, 3),
        Status.REFLEX: (3, 4),
        Status.ABORTED: (4, 5),
    },
    "AutomaticErrorRecovery": {
        Status.OK: (0, 0),
        Status.NOT_POSSIBLE: (1, 1),
        Status.MANUAL: (2, 3),
        Status.REFLEX: (3, 4),
        Status.EMERGENCY: (4, 5),
        Status.ABORTED: (5, 6),
    },
}
_OTHERS = {
    Status.OK: (0, 0),
    Status.NOT_POSSIBLE: (1, 1),
    Status.INCOMPATIBLE: (1, 1),
    Status.ERROR: (1, 1),
    Status.INVALID: (2, 2),
}


@dataclass(frozen=True, slots=True)
class Request:
    """One request of a client.

    Attributes:
        name: what it asks for.
        number: its number on the wire.
        ident: the client's counter, to be repeated in the reply.
        payload: what follows the header.
    """

    name: str
    number: int
    ident: int
    payload: bytes

    def numbers(self) -> Array:
        """The payload as f64 (k,), for the requests that hold nothing else."""
        return np.frombuffer(self.payload, "<f8").astype(float)

    def move_modes(self) -> tuple[int, int]:
        """Controller and generator mode that a Move asks for."""
        controller, generator = struct.unpack_from("<II", self.payload)
        return int(controller), int(generator)

    def connect_terms(self) -> tuple[int, int]:
        """Version and UDP port of a Connect."""
        version, port = _CONNECT.unpack(self.payload)
        return int(version), int(port)


class BadRequest(ValueError):
    """Bytes that are no request of this protocol; the connection cannot go on."""


class RequestReader:
    """Cuts a TCP stream into requests."""

    def __init__(self, version: int) -> None:
        self._version, self._held = version, bytearray()

    def feed(self, data: bytes) -> list[Request]:
        """The requests that are complete with `data`. Raises BadRequest."""
        self._held += data
        found = []
        while len(self._held) >= HEADER.size:
            number, ident, size = HEADER.unpack_from(self._held)
            names = NAMES[self._version]
            if number >= len(names):
                raise BadRequest(f"no command {number} in protocol {self._version}")
            name = names[number]
            payload = 113 if name == "Move" and self._version == 10 else SIZES[name]
            # A client of another version learns of it from the reply to Connect, alike in all.
            if size != HEADER.size + payload:
                raise BadRequest(f"{name} of {size} bytes; has: {HEADER.size + payload}")
            if len(self._held) < size:
                break
            found.append(Request(name, number, ident, bytes(self._held[HEADER.size : size])))
            del self._held[:size]
        return found


def reply(request: Request, status: Status, version: int, rest: bytes = b"") -> bytes:
    """A reply: header, status byte, and whatever this request's reply has besides."""
    code = _CODES.get(request.name, _OTHERS)[status][version == 10]
    size = HEADER.size + 1 + len(rest)
    return HEADER.pack(request.number, request.ident, size) + bytes((code,)) + rest
