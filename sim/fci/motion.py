"""A motion in progress: what was asked for, which commands arrived, and whether limits are kept."""

from __future__ import annotations

import numpy as np

from sim.fci.arm import Arm
from sim.fci.cartesian import HAND_LIMITS, CartesianMotion, broken
from sim.fci.codec import JOINTS, TICK_S, ControllerMode, Generator, Request, RobotCommand
from sim.truth import Array, Limits

START_TOLERANCE = 1e-3  # rad, first position from q_d; the robot's own is not published
WINDOW = 100  # commands that the success rate counts (Franka FCI documentation)
# Until the first command the client still changes over from replies to states. Chosen here: longer
# than 20 ms, since a client on a machine without real-time kernel may be held up just then.
FIRST_COMMAND_TICKS = 200
# N m from one tick to the next; the margin is the rounding of an f32 tau_J_d near 87 N m.
TORQUE_STEP, ROUNDING = 1.0, 1e-5
COMMUNICATION = "communication_constraints_violation"
CARTESIAN_GENERATORS = (Generator.CARTESIAN_POSITION, Generator.CARTESIAN_VELOCITY)


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
            if self._fresh and not (np.abs(q - self.q) <= START_TOLERANCE).all():
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
    """From Move's first reply to its second.

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
        if self.generator in CARTESIAN_GENERATORS:
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
        if not self.begun:
            return 0.0
        return int(self._arrived.sum()) / min(self._ticks, WINDOW)

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
            return COMMUNICATION if self._before >= FIRST_COMMAND_TICKS else None
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
