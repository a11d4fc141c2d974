"""The robot: modes, motions, reflexes and recovery, tick by tick, and what it says of itself.

Knows no sockets and no clock.
"""

from __future__ import annotations

import numpy as np

from sim.fci.arm import Arm, Settings
from sim.fci.cartesian import ELBOW_FLIP, HAND_LIMITS, CartesianMotion, broken
from sim.fci.codec import (
    ERRORS,
    JOINTS,
    TICK_S,
    ControllerMode,
    Floats,
    Generator,
    Request,
    RobotCommand,
    RobotMode,
    StateFrame,
    Status,
    reply,
)
from sim.scenarios import Scenario
from sim.truth import Array, Limits

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


WINDOW = 100  # commands that the success rate counts (Franka FCI documentation)
# Until the first command the client still changes over from replies to states. Chosen here: longer
# than 20 ms, since a client on a machine without real-time kernel may be held up just then.
# N m from one tick to the next; the margin is the rounding of an f32 tau_J_d near 87 N m.
TORQUE_STEP, ROUNDING = 1.0, 1e-5
COMMUNICATION = "communication_constraints_violation"


class DesiredMotion:
    """Desired joint motion; derivatives are backward differences over a tick.

    Attributes:
        q, dq, ddq: (7,) what the robot follows, rad, rad/s, rad/s².
    """

    def __init__(self, kind: Generator, q: Array, limits: Limits) -> None:
        self._kind, self._limits, self._fresh = kind, limits, True
        self.q, self.dq, self.ddq = q.copy(), np.zeros(len(q)), np.zeros(len(q))

    def follow(self, command: RobotCommand) -> str | None:
        """Take a command, of which the kind's part counts; the error that it commits, if any."""
        q, dq = command.q, command.dq
        if self._kind == Generator.JOINT_POSITION:
            if self._fresh and not (np.abs(q - self.q) <= 1e-3).all():  # rad
                return "joint_position_motion_generator_start_pose_invalid"
            return self._go(q.copy(), (q - self.q) / TICK_S)
        return self._go(self.q + dq * TICK_S, dq.copy())

    def extrapolate(self) -> None:
        """A command is missing: go on with constant acceleration."""
        self.dq = self.dq + self.ddq * TICK_S
        self.q = self.q + self.dq * TICK_S

    def ends(self) -> str | None:
        """The error of finishing now: the motion would have to stand still at the next tick."""
        return self._go(self.q, np.zeros(len(self.q)))

    def _go(self, q: Array, dq: Array) -> str | None:
        ddq = (dq - self.dq) / TICK_S
        found = broken(self._limits, "joint_motion_generator", q, (dq, ddq, self.ddq))
        if found is None:
            self.q, self.dq, self.ddq, self._fresh = q, dq, ddq, False
        return found


def allowed(controller: int, generator: int, version: int) -> bool:
    """Whether this robot makes such a motion."""
    if (controller, generator) == (ControllerMode.EXTERNAL, Generator.NONE):
        return version == 10
    return 0 <= controller < ControllerMode.OTHER and 0 <= generator < Generator.NONE


class CommandedMotion:
    """From Move's first reply to its second: what was asked for, which commands arrived.

    Attributes:
        request: the Move, whose id the second reply repeats.
        controller: the mode asked for.
        generator: the mode asked for.
        tau: (7,) last accepted torque, N m, held where a command is missing.
        path: the desired motion; at rest with torques alone.
        finished: the client has raised the finish flag.
    """

    def __init__(self, request: Request, arm: Arm, version: int) -> None:
        controller, generator = request.move_modes()
        self.request = request
        self.controller, self.generator = ControllerMode(controller), Generator(generator)
        self.tau: Array = np.zeros(JOINTS)
        self.path: DesiredMotion | CartesianMotion
        if self.generator in (Generator.CARTESIAN_POSITION, Generator.CARTESIAN_VELOCITY):
            limits, hand, pose = arm.truth.limits, HAND_LIMITS[version], arm.frame(arm.q)[0]
            self.path = CartesianMotion(self.generator, arm.q, limits, hand, arm.reach, pose)
        else:
            self.path = DesiredMotion(self.generator, arm.q, arm.truth.limits)
        self.finished = False
        self._arrived = np.zeros(WINDOW, dtype=bool)
        self._ticks = self._missed = self._before = 0

    @property
    def by_torque(self) -> bool:
        """The client's torques drive the arm, not the internal controller."""
        return self.controller == ControllerMode.EXTERNAL

    @property
    def begun(self) -> bool:
        """A first command has come; from then on they are due."""
        return self._ticks > 0

    @property
    def success_rate(self) -> float:
        """Share of the last 100 commands that arrived."""
        return 0.0 if not self.begun else int(self._arrived.sum()) / min(self._ticks, WINDOW)

    def take(self, command: RobotCommand | None) -> str | None:
        """The command of a tick, or None where it is missing; the error that ends the motion."""
        if command is None:
            return self._miss()
        self._note(True)
        self._missed = 0
        if self.by_torque:
            if not (np.abs(command.tau - self.tau) <= TORQUE_STEP + ROUNDING).all():
                return "controller_torque_discontinuity"
            self.tau = command.tau.copy()
        if self.generator == Generator.NONE:
            self.finished = command.torque_finished
            return None
        self.finished = command.generator_finished
        found = self.path.follow(command)
        if found is None and self.finished:
            found = self.path.ends()
        return found

    def _miss(self) -> str | None:
        if not self.begun:  # nothing is due before the first one
            self._before += 1
            return COMMUNICATION if self._before >= 200 else None
        self._note(False)
        self._missed += 1
        if self._missed >= 20:  # in a row, then communication_constraints_violation
            return COMMUNICATION
        if self.generator != Generator.NONE:
            self.path.extrapolate()
        return None

    def _note(self, arrived: bool) -> None:
        self._arrived[self._ticks % WINDOW] = arrived
        self._ticks += 1
