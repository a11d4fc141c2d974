"""The robot: modes, motions, reflexes and recovery, tick by tick; knows no sockets, no clock."""

from __future__ import annotations

import numpy as np

from sim.fci.arm import Arm
from sim.fci.layout import ERRORS, RobotCommand, RobotMode
from sim.fci.motion import Motion, allowed
from sim.fci.requests import Request, reply
from sim.fci.settings import Settings
from sim.fci.statuses import (
    ABORTED,
    EMERGENCY,
    INVALID,
    MANUAL,
    NOT_POSSIBLE,
    OK,
    PREEMPTED,
    REFLEX,
    STARTED,
)
from sim.scenarios import Scenario
from sim.truth import Array

RECOVERY_TICKS = 100  # chosen: long enough to be seen in states, short for tests
STANDING = 0.02  # rad/s, slower counts as standing

POSITION_LIMITS, TOO_FAST = "joint_position_limits_violation", "joint_velocity_violation"
TORQUE_RANGE, COLLISION, CARTESIAN_COLLISION = (
    "tau_J_range_violation",
    "joint_reflex",
    "cartesian_reflex",
)


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
        self.motion: Motion | None = None
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
        status = NOT_POSSIBLE if self.motion is not None else self.settings.apply(request)
        if status == OK:
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
        self._wait_for_operator()
        self._finish_recovery()

    def trip(self, *names: str) -> None:
        """End all motion by a reflex with these errors."""
        flags = [ERRORS.index(name) for name in names]
        self.violations.extend(names)
        self.errors[flags] = 1
        self.reflex_reason[flags] = 1
        self.mode = RobotMode.REFLEX if self.mode != RobotMode.USER_STOPPED else self.mode
        self._end(REFLEX)

    def stop_by_user(self, ticks: int) -> None:
        """The user stop is pressed for so long."""
        self.mode, self._user_stop_left = RobotMode.USER_STOPPED, ticks
        self._end(EMERGENCY)

    def drop_client(self) -> None:
        """The client is gone: its motion ends, nothing is replied any more."""
        self._end(ABORTED)
        self._recovery = None
        self._replies = []
        if self.mode == RobotMode.RECOVERY:
            self.mode = RobotMode.REFLEX

    def _start(self, request: Request) -> str:
        if self.mode != RobotMode.IDLE or self.motion is not None:
            return NOT_POSSIBLE
        if not allowed(*request.move_modes(), self.version):
            return INVALID
        self.motion = Motion(request, self.arm.q, self.arm.truth.limits)
        self.mode = RobotMode.MOVE
        self.reflex_reason[:] = 0
        return STARTED

    def _cancel(self) -> str:
        if self.mode == RobotMode.REFLEX:
            return REFLEX
        if self.mode == RobotMode.USER_STOPPED:
            return EMERGENCY
        self._end(PREEMPTED)
        return OK

    def _recover(self, request: Request) -> bytes | None:
        if self.mode == RobotMode.USER_STOPPED:
            return reply(request, EMERGENCY, self.version)
        if self.motion is not None or self._recovery is not None:
            return reply(request, NOT_POSSIBLE, self.version)
        if not self.arm.release():
            return reply(request, MANUAL, self.version)
        if self.mode != RobotMode.REFLEX:
            return reply(request, OK, self.version)
        self.mode, self._recovery = RobotMode.RECOVERY, request
        self._recovered_in = RECOVERY_TICKS
        return None

    def _finish_recovery(self) -> None:
        if self._recovery is None:
            return
        self._recovered_in -= 1
        if self.mode != RobotMode.RECOVERY:  # a reflex or the user stop came in between
            status = EMERGENCY if self.mode == RobotMode.USER_STOPPED else REFLEX
        elif self._recovered_in > 0 or self.moving:
            return
        elif not self.arm.release():  # asked again: only a standing arm stays within its limits
            status, self.mode = MANUAL, RobotMode.REFLEX
        else:
            status, self.mode = OK, RobotMode.IDLE
            self.errors[:] = 0
            self.joint_collision[:], self.cartesian_collision[:] = 0.0, 0.0
        self._replies.append(reply(self._recovery, status, self.version))
        self._recovery = None

    def _wait_for_operator(self) -> None:
        if self.mode != RobotMode.USER_STOPPED:
            return
        self._user_stop_left -= 1
        if self._user_stop_left <= 0:
            self.mode = RobotMode.REFLEX if self.errors.any() else RobotMode.IDLE

    def _move(self, motion: Motion, command: RobotCommand | None) -> None:
        """Drive the arm for one tick of a motion, or end it."""
        self.received += command is not None
        self.missed += command is None and motion.begun
        found = motion.take(command)
        if found is not None:
            self.trip(found)
            return
        self.q_desired = motion.path.q
        if motion.finished:
            self._end(OK)
            return
        self.tau_desired = motion.tau
        if motion.by_torque:
            self.arm.drive(motion.tau)
        else:
            path = motion.path
            self.arm.track(path.q, path.dq, path.ddq, self.settings.stiffness)

    def _watch(self) -> None:
        """Limits of the arm itself and collisions, from what its sensors say."""
        arm, settings = self.arm, self.settings
        found = []
        if arm.outside:
            found.append(POSITION_LIMITS)
        if (np.abs(arm.dq) > arm.truth.limits.velocity).any():
            found.append(TOO_FAST)
        if arm.saturated:
            found.append(TORQUE_RANGE)
        hit = np.abs(arm.tau_external) > settings.upper_torque
        if hit.any():
            self.joint_collision[hit] = 1.0
            found.append(COLLISION)
        hit = np.abs(arm.wrench) > settings.upper_force
        if hit.any():
            self.cartesian_collision[hit] = 1.0
            found.append(CARTESIAN_COLLISION)
        if found:
            self.trip(*found)

    def _end(self, status: str) -> None:
        """Brake; the motion's second reply goes out after the next state."""
        self.arm.brake()
        self.tau_desired = np.zeros(self.arm.truth.n)
        if self.motion is None:
            return
        self._replies.append(reply(self.motion.request, status, self.version))
        self.motion = None
        if self.mode == RobotMode.MOVE:
            self.mode = RobotMode.IDLE
