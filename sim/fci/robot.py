"""The robot: modes, motions, reflexes and recovery, tick by tick, and what it says of itself.

Knows no sockets and no clock.
"""

from __future__ import annotations

import numpy as np

from sim.fci.arm import Arm, Settings
from sim.fci.cartesian import ELBOW_FLIP, CartesianMotion
from sim.fci.codec import (
    ERRORS,
    TICK_S,
    ControllerMode,
    Floats,
    Request,
    RobotCommand,
    RobotMode,
    StateFrame,
    Status,
    reply,
)
from sim.fci.motion import CommandedMotion, DesiredMotion, allowed
from sim.scenarios import Scenario
from sim.truth import Array

RECOVERY_TICKS = 100  # chosen: long enough to be seen in states, short for tests
STANDING = 0.02  # rad/s, slower counts as standing


class Robot:
    """One arm and its controller.

    Attributes:
        version: of the protocol.
        arm: the arm.
        settings: what clients have set.
        mode: as the state says it.
        motion: the one in progress.
        errors: (41,) those active.
        reflex_reason: (41,) those that ended the last motion.
        tau_desired: (7,) torques without gravity in force, N m.
        q_desired: (7,) rad.
        joint_collision, cartesian_collision: (7,), (6,) latched until recovery, 0 or 1.
        received, missed: commands in time, and ticks without one though it was due.
        violations: names of the errors that occurred, in order.
    """

    def __init__(self, scenario: Scenario, version: int) -> None:
        self.version, self.settings = version, Settings()
        self.arm = Arm(scenario, self.settings)
        self.mode = RobotMode.IDLE
        self.motion: CommandedMotion | None = None
        self.errors = np.zeros(len(ERRORS), dtype=np.uint8)
        self.reflex_reason = np.zeros(len(ERRORS), dtype=np.uint8)
        self.tau_desired = np.zeros(self.arm.truth.n)
        self.q_desired: Array = self.arm.q
        self.joint_collision, self.cartesian_collision = np.zeros(7), np.zeros(6)
        self.received = self.missed = 0
        self.violations: list[str] = []
        self._recovery: Request | None = None
        self._recovered_in = self._user_stop_left = 0
        self._replies: list[bytes] = []

    @property
    def moving(self) -> bool:
        """The arm has not come to a stand yet."""
        return bool((np.abs(self.arm.dq) > STANDING).any())

    def take_replies(self) -> list[bytes]:
        """Replies that became due with the last tick, to be sent after its state."""
        due, self._replies = self._replies, []
        return due

    def request(self, request: Request) -> bytes | None:
        """Answer a request of a connected client at once; None where the reply comes later."""
        if request.name == "Move":
            return reply(request, self._start(request), self.version)
        if request.name == "StopMove":
            return reply(request, self._cancel(), self.version)
        if request.name == "AutomaticErrorRecovery":
            return self._recover(request)
        status = Status.NOT_POSSIBLE if self.motion is not None else self.settings.apply(request)
        if status == Status.OK:
            self.arm.refresh(self.settings)
        return reply(request, status, self.version)

    def tick(self, command: RobotCommand | None) -> None:
        """One millisecond: take the command that arrived in time, move on, watch the limits."""
        if self.motion is not None:
            self._move(self.motion, command)
        self.arm.step()
        if self.motion is not None:
            self._watch()
        if self.motion is None:
            self.q_desired = self.arm.q
        if self.mode == RobotMode.USER_STOPPED:
            self._user_stop_left -= 1
            if self._user_stop_left <= 0:
                self.mode = RobotMode.REFLEX if self.errors.any() else RobotMode.IDLE
        self._finish_recovery()

    def trip(self, *names: str) -> None:
        """End all motion by a reflex with these errors."""
        flags = [ERRORS.index(name) for name in names]
        self.violations.extend(names)
        self.errors[flags] = 1
        self.reflex_reason[flags] = 1
        self.mode = RobotMode.REFLEX if self.mode != RobotMode.USER_STOPPED else self.mode
        self._end(Status.REFLEX)

    def stop_by_user(self, ticks: int) -> None:
        """The user stop is pressed for so long."""
        self.mode, self._user_stop_left = RobotMode.USER_STOPPED, ticks
        self._end(Status.EMERGENCY)

    def drop_client(self) -> None:
        """The client is gone: its motion ends, nothing is replied any more."""
        self._end(Status.ABORTED)
        self._recovery = None
        self._replies = []
        if self.mode == RobotMode.RECOVERY:
            self.mode = RobotMode.REFLEX

    def _start(self, request: Request) -> Status:
        if self.mode != RobotMode.IDLE or self.motion is not None:
            return Status.NOT_POSSIBLE
        if not allowed(*request.move_modes(), self.version):
            return Status.INVALID
        self.motion = CommandedMotion(request, self.arm, self.version)
        self.mode = RobotMode.MOVE
        self.reflex_reason[:] = 0
        return Status.STARTED

    def _cancel(self) -> Status:
        if self.mode == RobotMode.REFLEX:
            return Status.REFLEX
        if self.mode == RobotMode.USER_STOPPED:
            return Status.EMERGENCY
        self._end(Status.PREEMPTED)
        return Status.OK

    def _recover(self, request: Request) -> bytes | None:
        if self.mode == RobotMode.USER_STOPPED:
            return reply(request, Status.EMERGENCY, self.version)
        if self.motion is not None or self._recovery is not None:
            return reply(request, Status.NOT_POSSIBLE, self.version)
        if not self.arm.release():
            return reply(request, Status.MANUAL, self.version)
        if self.mode != RobotMode.REFLEX:
            return reply(request, Status.OK, self.version)
        self.mode, self._recovery = RobotMode.RECOVERY, request
        self._recovered_in = RECOVERY_TICKS
        return None

    def _finish_recovery(self) -> None:
        if self._recovery is None:
            return
        self._recovered_in -= 1
        if self.mode != RobotMode.RECOVERY:  # a reflex or the user stop came in between
            status = Status.EMERGENCY if self.mode == RobotMode.USER_STOPPED else Status.REFLEX
        elif self._recovered_in > 0 or self.moving:
            return
        elif not self.arm.release():  # asked again: only a standing arm stays within its limits
            status, self.mode = Status.MANUAL, RobotMode.REFLEX
        else:
            status, self.mode = Status.OK, RobotMode.IDLE
            self.errors[:] = 0
            self.joint_collision[:], self.cartesian_collision[:] = 0.0, 0.0
        self._replies.append(reply(self._recovery, status, self.version))
        self._recovery = None

    def _move(self, motion: CommandedMotion, command: RobotCommand | None) -> None:
        """Drive the arm for one tick of a motion, or end it."""
        self.received += command is not None
        self.missed += command is None and motion.begun
        found = motion.take(command)
        if found is not None:
            self.trip(found)
            return
        self.q_desired = motion.path.q
        if motion.finished:
            self._end(Status.OK)
            return
        self.tau_desired = motion.tau
        path = motion.path
        if motion.by_torque:
            self.arm.drive(motion.tau)
        elif motion.controller == ControllerMode.JOINT_IMPEDANCE:
            self.arm.track(path.q, path.dq, path.ddq, self.settings.stiffness)
        else:
            pose, twist, _ = self.hand_path(path)
            joints = path.q, path.dq, path.ddq
            self.arm.comply(pose, twist, joints, self.settings.cartesian_stiffness)

    def hand_path(self, path: DesiredMotion | CartesianMotion) -> tuple[Array, Array, Array]:
        """Pose (4, 4), twist and acceleration (6,) that a motion wants of the end effector."""
        if isinstance(path, CartesianMotion):
            return path.pose, path.twist, path.acceleration
        pose, J = self.arm.frame(path.q)
        return pose, J @ path.dq, np.zeros(6)

    def _watch(self) -> None:
        """Limits of the arm itself and collisions, from what its sensors say."""
        arm, settings = self.arm, self.settings
        found = []
        if arm.outside:
            found.append("joint_position_limits_violation")
        slowest, fastest = arm.truth.limits.speeds(arm.q)
        near_end = (arm.dq < slowest - STANDING) | (arm.dq > fastest + STANDING)
        if (near_end | (np.abs(arm.dq) > arm.truth.limits.velocity)).any():
            found.append("joint_velocity_violation")
        if arm.plant.saturated:
            found.append("tau_J_range_violation")
        hit = np.abs(arm.tau_external) > settings.upper_torque
        if hit.any():
            self.joint_collision[hit] = 1.0
            found.append("joint_reflex")
        hit = np.abs(arm.wrench) > settings.upper_force
        if hit.any():
            self.cartesian_collision[hit] = 1.0
            found.append("cartesian_reflex")
        if found:
            self.trip(*found)

    def _end(self, status: Status) -> None:
        """Brake; the motion's second reply goes out after the next state."""
        self.arm.plant.stop()
        self.tau_desired = np.zeros(self.arm.truth.n)
        if self.motion is None:
            return
        self._replies.append(reply(self.motion.request, status, self.version))
        self.motion = None
        if self.mode == RobotMode.MOVE:
            self.mode = RobotMode.IDLE


class Reporter:
    """Fills one frame in place, tick after tick.

    Attributes:
        frame: the datagram.
    """

    def __init__(self, robot: Robot) -> None:
        self.frame = StateFrame(robot.version)
        self._robot = robot
        self._tau = robot.arm.sample.tau

    def refresh(self) -> None:
        """Write what changes only when a client sets it."""
        settings, fields = self._robot.settings, self.frame.fields
        for name in ("F_T_NE", "NE_T_EE", "EE_T_K", "F_T_EE"):
            fields[name][:] = getattr(settings, name).ravel("F")
        mass, com, inertia = settings.load
        fields["m_load"][0] = mass
        fields["F_x_Cload"][:] = com
        fields["I_load"][:] = inertia.ravel("F")
        fields["O_ddP_O"][:] = self._robot.arm.truth.gravity

    def fill(self, message_id: int) -> None:
        """Write the present tick."""
        robot, frame = self._robot, self.frame
        self._measured(robot.arm)
        self._desired(robot)
        frame.errors[:], frame.reflex_reason[:] = robot.errors, robot.reflex_reason
        frame.set_id(message_id)
        motion = robot.motion
        if motion is None:
            frame.set_modes(0, ControllerMode.OTHER, robot.mode, 0.0)
        else:
            generator = motion.generator + 1
            frame.set_modes(generator, motion.controller, robot.mode, motion.success_rate)

    def _measured(self, arm: Arm) -> None:
        fields, sample, settings = self.frame.fields, arm.sample, self._robot.settings
        fields["q"][:] = fields["theta"][:] = sample.q
        fields["dq"][:] = fields["dtheta"][:] = sample.dq
        fields["tau_J"][:] = sample.tau
        fields["dtau_J"][:] = (sample.tau - self._tau) / TICK_S
        self._tau = sample.tau
        fields["O_T_EE"][:] = arm.pose.ravel("F")
        _elbow(fields["elbow"], sample.q)
        outer = arm.tau_external
        fields["tau_ext_hat_filtered"][:] = outer
        fields["O_F_ext_hat_K"][:] = arm.wrench
        R = arm.pose[:3, :3] @ settings.EE_T_K[:3, :3]
        local = fields["K_F_ext_hat_K"]
        local[:3], local[3:] = arm.wrench[:3] @ R, arm.wrench[3:] @ R
        fields["joint_contact"][:] = np.abs(outer) > settings.lower_torque
        fields["cartesian_contact"][:] = np.abs(arm.wrench) > settings.lower_force

    def _desired(self, robot: Robot) -> None:
        fields, motion = self.frame.fields, robot.motion
        fields["tau_J_d"][:] = robot.tau_desired
        fields["q_d"][:] = robot.q_desired
        fields["joint_collision"][:] = robot.joint_collision
        fields["cartesian_collision"][:] = robot.cartesian_collision
        if motion is None:
            for name in ("dq_d", "ddq_d", "O_dP_EE_d", "O_dP_EE_c", "O_ddP_EE_c"):
                fields[name][:] = 0.0
            pose = robot.arm.pose
        else:
            pose, twist, acceleration = robot.hand_path(motion.path)
            fields["dq_d"][:], fields["ddq_d"][:] = motion.path.dq, motion.path.ddq
            fields["O_dP_EE_d"][:] = fields["O_dP_EE_c"][:] = twist
            fields["O_ddP_EE_c"][:] = acceleration
        fields["O_T_EE_d"][:] = fields["O_T_EE_c"][:] = pose.ravel("F")
        _elbow(fields["elbow_d"], robot.q_desired)
        _elbow(fields["elbow_c"], robot.q_desired)


def _elbow(field: Floats, q: Array) -> None:  # position of joint 3, side of joint 4's flip
    field[0], field[1] = q[2], 1.0 if q[3] > ELBOW_FLIP else -1.0
