"""Motions by Cartesian poses or velocities: what is desired of the end effector, and its joints."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sim.dynamics import Frames, compiled, cross, end_effector
from sim.fci.codec import TICK_S, Generator, RobotCommand
from sim.truth import Array, Limits, turn_about

ELBOW_FLIP = -0.467002423653011  # rad of joint 4 (libfranka headers)
ELBOW_TOLERANCE = 1e-2  # rad, chosen
RIGID = 1e-4  # so far R^T R of a pose may be from the identity
# Differences over 1 ms of positions that the client had as f32 are off by up to 500 rad/s³
# (and 2e-4 rad/s), which a motion along its limits shall not be blamed for.
ROOM, SPEED_ROOM = 1.1, 1.001

SIGN = "cartesian_motion_generator_elbow_sign_inconsistent"
OF_JOINTS = "cartesian_motion_generator_joint"  # how errors of the joints' own motion begin

Reach = Callable[[Array, Array, float], tuple[Array, float]]


class HandLimits(NamedTuple):
    """Of the end effector: speed, acceleration and jerk, each of translation and of rotation."""

    speed: tuple[float, float]
    acceleration: tuple[float, float]
    jerk: tuple[float, float]


# By protocol version: Franka FCI documentation, limits in Cartesian space of FER and of FR3.
HAND_LIMITS = {
    5: HandLimits((1.7, 2.5), (13.0, 25.0), (6500.0, 12500.0)),
    10: HandLimits((3.0, 2.5), (9.0, 17.0), (4500.0, 8500.0)),
}


class CartesianMotion:
    """Desired motion of the end effector; derivatives are backward differences over a tick.

    The joint motion that follows from it is held to the arm's limits. Without an elbow in the
    command the joints take the nearest posture.

    Args:
        kind: by pose or by velocity.
        q: (7,) rad at the start.
        limits: of the joints.
        hand: limits of the end effector.
        reach: (posture to start from, pose, wanted joint 3 or NaN) -> posture and what it misses.
        pose: (4, 4) at the start.

    Attributes:
        q, dq, ddq: (7,) what the robot follows, rad, rad/s, rad/s².
        pose: (4, 4), twist: (6,), acceleration: (6,) of the end effector, base axes.
    """

    def __init__(
        self, kind: Generator, q: Array, limits: Limits, hand: HandLimits, reach: Reach, pose: Array
    ) -> None:
        self._by_pose = kind == Generator.CARTESIAN_POSITION
        self._limits, self._hand, self._reach, self._fresh = limits, hand, reach, True
        self._leads_elbow = False
        self.q, self.dq, self.ddq = q.copy(), np.zeros(len(q)), np.zeros(len(q))
        self.pose, self.twist, self.acceleration = pose.copy(), np.zeros(6), np.zeros(6)

    def follow(self, command: RobotCommand) -> str | None:
        """Take a command; the error that it commits, if any."""
        elbow, found = np.nan, self._wrong_elbow(command.elbow)
        if found is not None:
            return found
        self._leads_elbow = command.elbow is not None
        if command.elbow is not None:
            elbow = float(command.elbow[0])
        if not self._by_pose:
            return self._go(moved(self.pose, command.twist), command.twist.copy(), elbow)
        pose = command.pose.reshape(4, 4).T
        if not rigid(pose):
            return "cartesian_position_motion_generator_invalid_frame_flag"
        step = difference(self.pose, pose)
        # m and rad, the first pose from the desired one; the robot's own is not published
        if self._fresh and not (np.abs(step) <= 1e-3).all():
            return "cartesian_position_motion_generator_start_pose_invalid"
        return self._go(pose.copy(), step / TICK_S, elbow)

    def extrapolate(self) -> None:
        """A command is missing: go on with constant acceleration, of an elbow that is led too."""
        self.twist = self.twist + self.acceleration * TICK_S
        self.pose = moved(self.pose, self.twist)
        elbow = self.q[2] + (self.dq[2] + self.ddq[2] * TICK_S) * TICK_S
        goal = elbow if self._leads_elbow else np.nan
        self._take_joints(self._reach(self.q, self.pose, goal)[0])

    def ends(self) -> str | None:
        """The error of finishing now: the motion would have to stand still at the next tick."""
        return self._go(self.pose, np.zeros(6), np.nan)

    def _wrong_elbow(self, elbow: Array | None) -> str | None:
        if elbow is None:
            return None
        if elbow[1] != (1.0 if self.q[3] > ELBOW_FLIP else -1.0):
            return "start_elbow_sign_inconsistent" if self._fresh else SIGN
        away = abs(elbow[0] - self.q[2])
        if self._fresh:
            wrong = "cartesian_motion_generator_start_elbow_invalid"
            return None if away <= ELBOW_TOLERANCE else wrong
        step = 2.175 * TICK_S  # rad/s (Franka FCI documentation)
        far = "cartesian_motion_generator_elbow_limit_violation"
        return None if away <= ELBOW_TOLERANCE + step else far

    def _go(self, pose: Array, twist: Array, elbow: float) -> str | None:
        acceleration = (twist - self.twist) / TICK_S
        jerk = (acceleration - self.acceleration) / TICK_S
        hand = self._hand
        for value, most, error in (
            (twist, hand.speed, "cartesian_motion_generator_velocity_limits_violation"),
            (acceleration, hand.acceleration, "cartesian_motion_generator_velocity_discontinuity"),
            (jerk, hand.jerk, "cartesian_motion_generator_acceleration_discontinuity"),
        ):
            if not within(value, most):
                return error
        q, missed = self._reach(self.q, pose, elbow)
        if not missed <= 1e-3:  # m and rad
            return f"{OF_JOINTS}_position_limits_violation"
        before = self.q, self.dq, self.ddq
        self._take_joints(q)
        found = broken(self._limits, OF_JOINTS, q, (self.dq, self.ddq, before[2]))
        if found is not None:
            self.q, self.dq, self.ddq = before
            return found
        self.pose, self.twist, self.acceleration, self._fresh = pose, twist, acceleration, False
        return None

    def _take_joints(self, q: Array) -> None:
        dq = (q - self.q) / TICK_S
        self.q, self.dq, self.ddq = q, dq, (dq - self.dq) / TICK_S


def broken(limits: Limits, motion: str, q: Array, rates: tuple[Array, ...]) -> str | None:
    """The error of the first limit that a joint motion does not keep; a NaN keeps none.

    Args:
        limits: of the joints.
        motion: how names of its errors begin.
        q: (n,) rad; rates: dq, ddq at this tick and ddq at the one before, (n,) each.
    """
    dq, ddq, before = rates
    if not ((q >= limits.lower) & (q <= limits.upper)).all():
        return f"{motion}_position_limits_violation"
    slowest, fastest = limits.speeds(q)
    if not ((dq >= slowest * SPEED_ROOM) & (dq <= fastest * SPEED_ROOM)).all():
        return f"{motion}_velocity_limits_violation"
    most = limits.acceleration * ROOM
    if not (np.abs(ddq) <= most).all():
        return f"{motion}_velocity_discontinuity"
    # 1/s: 7500 rad/s³ at 15 rad/s² (Franka FCI documentation)
    if not (np.abs(ddq - before) <= 500.0 * TICK_S * most).all():
        return f"{motion}_acceleration_discontinuity"
    return None


def within(value: Array, most: tuple[float, float]) -> bool:
    """Whether both halves (3,) of a twist or its derivative keep their limits; no NaN does."""
    both = np.sqrt(value[:3] @ value[:3]), np.sqrt(value[3:] @ value[3:])
    return bool(both[0] <= most[0] * ROOM and both[1] <= most[1] * ROOM)


def rigid(pose: Array) -> bool:
    """Whether (4, 4) is a pose; no NaN is."""
    R = pose[:3, :3]
    straight = np.abs(R.T @ R - np.eye(3)).max() <= RIGID and np.linalg.det(R) > 0
    return bool(straight and np.isfinite(pose).all() and (pose[3] == (0, 0, 0, 1)).all())


def difference(old: Array, new: Array) -> Array:
    """(6,) translation and rotation vector from one pose to another, base axes."""
    R = new[:3, :3] @ old[:3, :3].T
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = np.sqrt(v @ v)  # of less than a half turn
    if sine >= 1e-9:
        v = v * (np.arctan2(sine, (np.trace(R) - 1) / 2) / sine)
    return np.concatenate((new[:3, 3] - old[:3, 3], v))


def moved(pose: Array, twist: Array) -> Array:
    """A pose (4, 4) one tick later under a twist (6,) in base axes."""
    out = pose.copy()
    out[:3, 3] += twist[:3] * TICK_S
    w = twist[3:] * TICK_S
    angle = np.sqrt(w @ w)
    if angle > 0.0:
        out[:3, :3] = turn_about(w / angle, float(angle)) @ out[:3, :3]
    return out


STEPS, CLOSE, DAMPING = 6, 1e-10, 1e-8  # of Newton's method; the last keeps singular postures calm


@compiled
def posture(
    frames: Frames, tool: Array, start: Array, pose: Array, elbow: float
) -> tuple[Array, float]:
    """The joints (n,) nearest to `start` that bring the end to a pose, by Newton's method.

    Args:
        frames: of the joints.
        tool: (4, 4) the end in the last link's frame.
        start: (n,) rad.
        pose: (4, 4) wanted.
        elbow: rad, wanted of joint 3; NaN for any.

    Returns:
        (n,) rad and what they miss of the pose, m and rad.
    """
    q, miss, turn = start.copy(), np.inf, np.empty(3)
    rows = 6 if np.isnan(elbow) else 7
    A, e = np.zeros((rows, len(q))), np.zeros(rows)
    for step in range(STEPS):
        at, J = end_effector(frames, q, tool)
        A[:6] = J
        e[:] = 0.0
        for k in range(3):
            e[k] = pose[k, 3] - at[k, 3]
            cross(np.ascontiguousarray(at[:3, k]), np.ascontiguousarray(pose[:3, k]), turn)
            for i in range(3):
                e[3 + i] += turn[i] / 2
        miss = np.abs(e[:6]).max()
        if rows == 7:
            A[6, 2], e[6] = 1.0, elbow - q[2]
        if np.abs(e).max() < CLOSE or step == STEPS - 1:
            break
        q += A.T @ np.linalg.solve(A @ A.T + DAMPING * np.eye(rows), e)
    return q, miss


@compiled
def impedance(
    M: Array, J: Array, error: Array, rate_error: Array, stiffness: Array, fastest: float
) -> tuple[Array, Array]:
    """Torques of a Cartesian spring with critical damping.

    Args:
        M: (n, n) mass matrix, kg m².
        J: (6, n) of the end.
        error, rate_error: (6,) pose and twist wanted minus real, base axes.
        stiffness: (6,) N/m and N m/rad.
        fastest: 1/s, rate beyond which a command per millisecond does not hold the spring stable.

    Returns:
        (n,) torques, N m, and (n, n) what of other torques leaves the end alone.
    """
    carried = np.linalg.solve(M, J.T)  # M^-1 J^T
    felt = np.linalg.inv(J @ carried + DAMPING * np.eye(6))
    weight = np.diag(felt).copy()
    spring = np.minimum(stiffness, weight * fastest * fastest)
    force = spring * error + 2 * np.sqrt(spring * weight) * rate_error
    return J.T @ force, np.eye(len(M)) - J.T @ (felt @ np.ascontiguousarray(carried.T))
