"""Joint motion as a client commands it: checked against the limits, continued where lost."""

from __future__ import annotations

import numpy as np

from sim.fci.arm import TICK_S
from sim.fci.layout import Generator
from sim.truth import Array, Limits

START_TOLERANCE = 1e-3  # rad, first position from q_d; the robot's own is not published
JERK_PER_ACCELERATION = 500.0  # 1/s: 7500 rad/s³ at 15 rad/s² (Franka FCI documentation)
# Differences over 1 ms of positions that the client had as f32 are off by up to 500 rad/s³
# (and 2e-4 rad/s), which a motion along its limits shall not be blamed for.
ROOM, SPEED_ROOM = 1.1, 1.001

START_POSE = "joint_position_motion_generator_start_pose_invalid"
POSITION = "joint_motion_generator_position_limits_violation"
VELOCITY = "joint_motion_generator_velocity_limits_violation"
ACCELERATION = "joint_motion_generator_velocity_discontinuity"
JERK = "joint_motion_generator_acceleration_discontinuity"


class JointMotion:
    """Desired joint motion; derivatives are backward differences over a tick.

    Attributes:
        q, dq, ddq: (7,) what the robot follows, rad, rad/s, rad/s².
    """

    def __init__(self, kind: Generator, q: Array, limits: Limits) -> None:
        self._kind, self._limits, self._fresh = kind, limits, True
        self.q, self.dq, self.ddq = q.copy(), np.zeros(len(q)), np.zeros(len(q))

    def follow(self, q: Array, dq: Array) -> str | None:
        """Take a command, of which the kind's part counts; the error that it commits, if any."""
        if self._kind == Generator.JOINT_POSITION:
            if self._fresh and not (np.abs(q - self.q) <= START_TOLERANCE).all():
                return START_POSE
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
        jerk = (ddq - self.ddq) / TICK_S
        found = self._broken(q, dq, ddq, jerk)
        if found is None:
            self.q, self.dq, self.ddq, self._fresh = q, dq, ddq, False
        return found

    def _broken(self, q: Array, dq: Array, ddq: Array, jerk: Array) -> str | None:
        """The first limit that is not kept; written so that a NaN keeps none."""
        limits = self._limits
        if not ((q >= limits.lower) & (q <= limits.upper)).all():
            return POSITION
        if not (np.abs(dq) <= limits.velocity * SPEED_ROOM).all():
            return VELOCITY
        most = limits.acceleration * ROOM
        if not (np.abs(ddq) <= most).all():
            return ACCELERATION
        if not (np.abs(jerk) <= JERK_PER_ACCELERATION * most).all():
            return JERK
        return None
