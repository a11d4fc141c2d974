"""A motion in progress: what was asked for, and which of its commands arrived."""

from __future__ import annotations

import numpy as np

from sim.fci.generators import JointMotion
from sim.fci.layout import JOINTS, Controller, Generator, RobotCommand
from sim.fci.requests import Request
from sim.truth import Array, Limits

WINDOW = 100  # commands that the success rate counts (Franka FCI documentation)
MOST_MISSED = 20  # in a row, then communication_constraints_violation
# Until the first command the client still changes over from replies to states. Chosen here: longer
# than 20 ms, since a client on a machine without real-time kernel may be held up just then.
FIRST_COMMAND_TICKS = 200
# N m from one tick to the next; the margin is the rounding of an f32 tau_J_d near 87 N m.
TORQUE_STEP, ROUNDING = 1.0, 1e-5

COMMUNICATION = "communication_constraints_violation"
TORQUE_JUMP = "controller_torque_discontinuity"

POSSIBLE = {
    (Controller.JOINT_IMPEDANCE, Generator.JOINT_POSITION),
    (Controller.JOINT_IMPEDANCE, Generator.JOINT_VELOCITY),
    (Controller.CARTESIAN_IMPEDANCE, Generator.JOINT_POSITION),
    (Controller.CARTESIAN_IMPEDANCE, Generator.JOINT_VELOCITY),
    (Controller.EXTERNAL, Generator.JOINT_POSITION),
    (Controller.EXTERNAL, Generator.JOINT_VELOCITY),
}


def allowed(controller: int, generator: int, version: int) -> bool:
    """Whether this robot makes such a motion; Cartesian generators it does not."""
    if (controller, generator) == (Controller.EXTERNAL, Generator.NONE):
        return version == 10
    return (controller, generator) in POSSIBLE


class Motion:
    """From Move's first reply to its second.

    Attributes:
        request: the Move, whose id the second reply repeats.
        controller: the mode asked for.
        generator: the mode asked for.
        tau: (7,) last accepted torque, N m, held where a command is missing.
        path: the desired joint motion; at rest with torques alone.
        finished: the client has raised the finish flag.
    """

    def __init__(self, request: Request, q: Array, limits: Limits) -> None:
        controller, generator = request.move_modes()
        self.request = request
        self.controller, self.generator = Controller(controller), Generator(generator)
        self.tau: Array = np.zeros(JOINTS)
        self.path = JointMotion(self.generator, q, limits)
        self.finished = False
        self._arrived = np.zeros(WINDOW, dtype=bool)
        self._ticks = self._missed = self._before = 0

    @property
    def by_torque(self) -> bool:
        """The client's torques drive the arm, not the internal controller."""
        return self.controller == Controller.EXTERNAL

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
                return TORQUE_JUMP
            self.tau = command.tau.copy()
        if self.generator == Generator.NONE:
            self.finished = command.torque_finished
            return None
        self.finished = command.generator_finished
        found = self.path.follow(command.q, command.dq)
        if found is None and self.finished:
            found = self.path.ends()
        return found

    def _miss(self) -> str | None:
        if not self.begun:  # nothing is due before the first one
            self._before += 1
            return COMMUNICATION if self._before >= FIRST_COMMAND_TICKS else None
        self._note(False)
        self._missed += 1
        if self._missed >= MOST_MISSED:
            return COMMUNICATION
        if self.generator != Generator.NONE:
            self.path.extrapolate()
        return None

    def _note(self, arrived: bool) -> None:
        self._arrived[self._ticks % WINDOW] = arrived
        self._ticks += 1
