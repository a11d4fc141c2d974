"""The 41 errors that a Franka robot can raise, and what to do about each.

Order of the bitmap and names: Franka FCI documentation and libfranka headers; the same in
protocols 5 and 10. The advice is ours.
"""

from __future__ import annotations

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


def raised(bitmap: bytes) -> tuple[str, ...]:
    """Names of the errors set in a bitmap of 41 bytes."""
    return tuple(name for name, flag in zip(ERROR_NAMES, bitmap, strict=True) if flag)


def told(bitmap: bytes) -> str:
    """Every error set in a bitmap with its advice; "no error is named" for none."""
    names = raised(bitmap)
    if not names:
        return "no error is named"
    return "; ".join(f"{name} ({ERRORS[name]})" for name in names)
