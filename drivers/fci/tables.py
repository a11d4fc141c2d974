"""Versions, modes, status codes and errors of the FCI, and a sentence for each.

Numbers: Franka FCI documentation, libfranka 0.9.2 (protocol 5) and 0.21.2 (protocol 10) headers.
The order of the error bitmap and its names are the same in both; the advice is ours.
"""

from __future__ import annotations

PANDA, FR3 = 5, 10  # protocol versions
PORT = 1337  # TCP, fixed by the robot

# Commands that this driver sends, id by version.
CONNECT = {PANDA: 0, FR3: 0}
MOVE = {PANDA: 1, FR3: 1}
STOP_MOVE = {PANDA: 2, FR3: 2}
RECOVER = {PANDA: 12, FR3: 10}  # AutomaticErrorRecovery
SETTINGS = {"SetCollisionBehavior": {PANDA: 4, FR3: 3}, "SetLoad": {PANDA: 10, FR3: 9}}

# Modes in a state.
CONTROLLER_TORQUE = 2
CONTROLLER_MODES = 4
GENERATOR_MODES = {PANDA: 5, FR3: 6}
RUNNING_GENERATOR = {PANDA: 2, FR3: 5}  # joint velocity (all zero); none
MOVE_GENERATOR = {PANDA: 1, FR3: 4}  # the same in a Move request
ROBOT_OTHER, ROBOT_IDLE, ROBOT_MOVE, ROBOT_GUIDING = 0, 1, 2, 3
ROBOT_REFLEX, ROBOT_USER_STOP, ROBOT_RECOVERY = 4, 5, 6
ROBOT_MODES = 8  # 7 is read as "other" by the clients

LIBFRANKA = {  # by protocol version
    5: "libfranka 0.9",
    6: "libfranka 0.10 to 0.13.2",
    7: "libfranka 0.13.3",
    8: "libfranka 0.14",
    9: "libfranka 0.15",
    10: "libfranka 0.18 and newer",
}

_MOVE = (
    *("success", "motion_started", "preempted", "not_possible", "singular_start"),
    *("invalid_argument", "reflex", "user_stop", "input_error", "aborted"),
)
_STOP = ("success", "not_possible", "user_stop", "reflex", "aborted")
_RECOVER = ("success", "not_possible", "manual_recovery", "reflex", "user_stop", "aborted")
# An FR3 knows its safety functions as well.
MOVE_STATUS = {
    PANDA: _MOVE,
    FR3: (*_MOVE[:3], "preempted_by_safety", "rejected_by_safety", *_MOVE[3:]),
}
STOP_STATUS = {PANDA: _STOP, FR3: (*_STOP[:2], "rejected_by_safety", *_STOP[2:])}
RECOVER_STATUS = {PANDA: _RECOVER, FR3: (*_RECOVER[:2], "rejected_by_safety", *_RECOVER[2:])}
SET_STATUS = ("success", "not_possible", "invalid_argument", "rejected_by_safety")  # FR3: the last

MEANING = {
    "success": "it says that all is done",
    "motion_started": "it says that the motion started",
    "preempted": "the motion was preempted: end the other program or task that moves the arm",
    "preempted_by_safety": "a safety function ended the motion: look at Desk, clear it",
    "rejected_by_safety": "a safety function forbids it: look at Desk and clear it",
    "not_possible": "it is not possible now: unlock the brakes, activate FCI and leave "
    "programming mode in Desk; after a reflex recover first (?recover=1)",
    "singular_start": "the arm starts in a singular posture: guide it elsewhere",
    "invalid_argument": "it takes our request for invalid: check its system version",
    "reflex": "a reflex stopped the arm: clear the cause, then recover (?recover=1)",
    "user_stop": "the user stop is pressed: release it when the arm may move",
    "input_error": "it could not use our commands: check its system version and the network",
    "aborted": "it aborted: look at Desk for the cause, start again",
    "manual_recovery": "the error needs hands: open Desk, recover there (joint limits: guide the "
    "arm back)",
}

ROBOT_MODE_MEANING = {
    ROBOT_OTHER: "is not ready: unlock the brakes and activate FCI in Desk",
    ROBOT_IDLE: "is idle",
    ROBOT_MOVE: "is moving for another program: end that first",
    ROBOT_GUIDING: "is being guided by hand: let go and leave the guiding mode",
    ROBOT_REFLEX: "is in reflex: clear the cause, then recover (?recover=1, or in Desk)",
    ROBOT_USER_STOP: "has its user stop pressed: release it when the arm may move",
    ROBOT_RECOVERY: "recovers from an error: wait until it is done",
    7: "is not ready: unlock the brakes and activate FCI in Desk",
}
_SMOOTHER = "ask for smoother motion"
_NO_GENERATOR = "this driver commands torques only; look for another program that moves the arm"
_BASE = "power the robot off and on; if it stays, its base sensor needs Franka's service"
ERRORS: dict[str, str] = {
    "joint_position_limits_violation": "guide the arm back from the joint's end by hand, recover",
    "cartesian_position_limits_violation": "guide the arm back into its work space, recover",
    "self_collision_avoidance_violation": "guide the arm away from itself, recover",
    "joint_velocity_violation": "a joint was too fast: move slower (--speed), recover",
    "cartesian_velocity_violation": "the hand was too fast: move slower (--speed), recover",
    "force_control_safety_violation": "look for contact, clear it, recover",
    "joint_reflex": "a joint felt a collision: clear the way, check the load set in Desk, recover",
    "cartesian_reflex": "the hand felt a collision: clear the way, check the load, recover",
    "max_goal_pose_deviation_violation": _NO_GENERATOR,
    "max_path_pose_deviation_violation": _NO_GENERATOR,
    "cartesian_velocity_profile_safety_violation": "move slower (--speed), recover",
    "joint_position_motion_generator_start_pose_invalid": _NO_GENERATOR,
    "joint_motion_generator_position_limits_violation": _NO_GENERATOR,
    "joint_motion_generator_velocity_limits_violation": _NO_GENERATOR,
    "joint_motion_generator_velocity_discontinuity": _NO_GENERATOR,
    "joint_motion_generator_acceleration_discontinuity": _NO_GENERATOR,
    "cartesian_position_motion_generator_start_pose_invalid": _NO_GENERATOR,
    "cartesian_motion_generator_elbow_limit_violation": _NO_GENERATOR,
    "cartesian_motion_generator_velocity_limits_violation": _NO_GENERATOR,
    "cartesian_motion_generator_velocity_discontinuity": _NO_GENERATOR,
    "cartesian_motion_generator_acceleration_discontinuity": _NO_GENERATOR,
    "cartesian_motion_generator_elbow_sign_inconsistent": _NO_GENERATOR,
    "cartesian_motion_generator_start_elbow_invalid": _NO_GENERATOR,
    "force_controller_desired_force_tolerance_violation": "clear any contact, recover",
    "start_elbow_sign_inconsistent": _NO_GENERATOR,
    "communication_constraints_violation": (
        "the robot missed 20 commands in a row: use a wired network of its own, a real-time "
        "kernel and an idle computer, recover"
    ),
    "power_limit_violation": "the arm took too much power: move slower or with less load, recover",
    "cartesian_motion_generator_joint_position_limits_violation": _NO_GENERATOR,
    "cartesian_motion_generator_joint_velocity_limits_violation": _NO_GENERATOR,
    "cartesian_motion_generator_joint_velocity_discontinuity": _NO_GENERATOR,
    "cartesian_motion_generator_joint_acceleration_discontinuity": _NO_GENERATOR,
    "cartesian_position_motion_generator_invalid_frame_flag": _NO_GENERATOR,
    "controller_torque_discontinuity": (
        f"the torque jumped by more than 1 N m in 1 ms, commands got lost: {_SMOOTHER} or use a "
        "better network, recover"
    ),
    "joint_p2p_insufficient_torque_for_planning": _NO_GENERATOR,
    "tau_J_range_violation": "a torque sensor left its range: remove load or contact, recover",
    "instability_detected": "the arm oscillated: lower the gains of the control, recover",
    "joint_move_in_wrong_direction": "guide the joint back into its range by hand, recover",
    "cartesian_spline_motion_generator_violation": _NO_GENERATOR,
    "joint_via_motion_generator_planning_joint_limit_violation": _NO_GENERATOR,
    "base_acceleration_initialization_timeout": _BASE,
    "base_acceleration_invalid_reading": _BASE,
}
ERROR_NAMES = tuple(ERRORS)
ERROR_COUNT = 41


def status_name(statuses: tuple[str, ...], status: int) -> str:
    """Name of a status code; "status N" for a code nobody defined."""
    return statuses[status] if status < len(statuses) else f"status {status}"


def meaning(name: str) -> str:
    """What a status says and what to do, as the end of a sentence."""
    return MEANING.get(name, f"it answers {name}, which is not defined: check its system version")


def version_trouble(server: int, asked: int) -> str:
    """Why a robot of this version cannot be talked to, as the end of a sentence."""
    what = LIBFRANKA.get(server, "no libfranka known here")
    if server in (PANDA, FR3):
        return f"speaks FCI protocol {server} ({what}), not {asked}: use ?protocol={server}"
    return (
        f"speaks FCI protocol {server} ({what}); supported are 5 (Panda/FER, libfranka 0.9) and "
        "10 (FR3, libfranka 0.18 and newer): bring its system to one of these"
    )


def raised(bitmap: bytes) -> tuple[str, ...]:
    """Names of the errors set in a bitmap of 41 bytes."""
    return tuple(name for name, flag in zip(ERROR_NAMES, bitmap, strict=True) if flag)


def told(bitmap: bytes) -> str:
    """Every error set in a bitmap with its advice; "no error is named" for none."""
    names = raised(bitmap)
    if not names:
        return "no error is named"
    return "; ".join(f"{name} ({ERRORS[name]})" for name in names)
