"""What the robot says of itself, once a tick: a RobotState."""

from __future__ import annotations

import numpy as np

from sim.fci.arm import TICK_S, Arm
from sim.fci.layout import Controller, Floats, StateFrame
from sim.fci.robot import Robot
from sim.truth import Array

ELBOW_FLIP = -0.467002423653011  # rad of joint 4 (libfranka headers)


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
            frame.set_modes(0, Controller.OTHER, robot.mode, 0.0)
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
            for name in ("dq_d", "ddq_d", "O_dP_EE_d", "O_dP_EE_c"):
                fields[name][:] = 0.0
            pose = robot.arm.pose
        else:
            pose, J = robot.arm.frame(robot.q_desired)
            fields["dq_d"][:], fields["ddq_d"][:] = motion.path.dq, motion.path.ddq
            fields["O_dP_EE_d"][:] = fields["O_dP_EE_c"][:] = J @ motion.path.dq
        fields["O_T_EE_d"][:] = fields["O_T_EE_c"][:] = pose.ravel("F")
        _elbow(fields["elbow_d"], robot.q_desired)
        _elbow(fields["elbow_c"], robot.q_desired)


def _elbow(field: Floats, q: Array) -> None:  # position of joint 3, side of joint 4's flip
    field[0], field[1] = q[2], 1.0 if q[3] > ELBOW_FLIP else -1.0
