"""The arm's motion over one tick, by PyBullet, with every signal brought to its instant.

PyBullet steps by semi-implicit Euler: v' = v + h a(q, v), then q' = q + h v'. Read as it stands,
velocity and position are half a sub-step apart. Here the stored velocity is taken as that of the
stamp and the stored position as that of half a sub-step later: position Verlet, second order.
The torque that belongs to such a step is that of its middle, and the position at the stamp is
the stored one minus h/2 times the velocity. What is left is that PyBullet takes velocity-dependent
forces at the step's start; the change of the Coriolis torque over half a sub-step is added (left
out, it reads as a lag of 30 µs between torque and acceleration).

Friction and what else acts on a joint enter the sub-step at its middle, stiff parts implicitly
(`sim.joint_effects.step`). Where masses or gravity change, the arm moves on as another rigid arm.
"""

from __future__ import annotations

import weakref
from typing import NamedTuple

import numpy as np
import pybullet as bullet

from sim.dynamics import end_effector
from sim.effects import WRENCH
from sim.joint_effects import Obstacles, add_up, bend, friction, rows_of, step
from sim.rigid_bodies import ArmClient, disconnect, load, rigid_truths
from sim.truth import Array, Truth

PERIOD_S = 1e-3
SUBSTEPS = 4  # of 0.25 ms
FORCES = ("fx", "fy", "fz", "mx", "my", "mz")


class DriveLaw(NamedTuple):
    """What the drives do during a tick, (n,) each: kp (q_des - q) + kd (dq_des - dq) + ff, cut.

    A drive evaluates its law far more often than a millisecond, so that the law is part of every
    sub-step, with its damping at the middle: kd = 5 N m s/rad on a wrist joint of 0.005 kg m²
    would be unstable if it lagged by a tick.

    Attributes:
        q_des, dq_des, kp, kd: rad, rad/s, N m/rad, N m s/rad.
        ff0: feed-forward torque at the start of the tick, N m.
        ff1: at its end; linear in between.
        most: limit of a drive's torque, N m; 0 for one that does not drive.
    """

    q_des: Array
    dq_des: Array
    kp: Array
    kd: Array
    ff0: Array
    ff1: Array
    most: Array


class Engine:
    """The rigid arm in its stages and all that acts on its joints; knows nothing of commands.

    Attributes:
        stopped: a joint touched an end stop during the last tick.
        obstacles: what is in the arm's way.
    """

    def __init__(self, truth: Truth, substeps: int = SUBSTEPS, end_stops: bool = False) -> None:
        """Load the arm.

        Args:
            truth: arm and effects; those of the sensors are not this class's business.
            substeps: of a tick.
            end_stops: whether joints have springs at the ends of their ranges.

        Raises:
            ValueError: a body that cannot be simulated.
        """
        self._n, self._substeps = truth.n, substeps
        self._h = PERIOD_S / substeps
        self._joints, self._rest = list(range(truth.n)), np.zeros(truth.n)
        self._lower = truth.limits.lower if end_stops else np.full(truth.n, -np.inf)
        self._upper = truth.limits.upper if end_stops else np.full(truth.n, np.inf)
        self.stopped, self._end_stops = False, end_stops
        self._mass: Array | None = None
        self._rows = rows_of(truth)
        self._bent = np.zeros(len(self._rows))
        self._wrenches = [
            (effect.start_s, effect.end_s, np.array([effect.number(key) for key in FORCES]))
            for effect in truth.effects
            if effect.place == WRENCH
        ]
        self.obstacles = Obstacles(truth.effects, truth.n)
        self._stages: list[ArmClient] = []
        clients: list[int] = []
        self._close = weakref.finalize(self, disconnect, clients)
        for start_s, rigid in rigid_truths(truth, PERIOD_S):
            self._stages.append(load(start_s, rigid, self._h))
            clients.append(self._stages[-1].client)
        self._ticks, self._start_s = 0, 0.0
        self._stage = self._stages[0]
        self.place(self._rest, self._rest)

    @property
    def truth(self) -> Truth:
        """The rigid arm as it is at present."""
        return self._stage.truth

    def place(self, q: Array, dq: Array, t_s: float = 0.0) -> None:
        """Put the arm at q (n,) rad with dq (n,) rad/s at the time t_s."""
        self.set_time(t_s)
        self._stage = self._due()
        self._set(q + self._h / 2 * dq, dq)
        self._q, self._dq = q, dq
        self._ddq: Array | None = None  # unknown before the first tick

    def set_time(self, t_s: float) -> None:
        """What the effects' clock shows from now on."""
        self._ticks, self._start_s = 0, t_s

    def state(self) -> tuple[Array, Array]:
        """q (n,) rad and dq (n,) rad/s of the links at the stamp."""
        return self._q, self._dq

    def tick(self, start: Array, end: Array) -> None:
        """Move on by one period, driving torque (n,) N m linear from `start` to `end`."""
        nothing = self._rest
        self.drive(
            DriveLaw(nothing, nothing, nothing, nothing, start, end, np.full(self._n, np.inf))
        )

    def drive(self, law: DriveLaw) -> None:
        """Move on by one period under a law of the drives."""
        t, h, stored, dq = self._now(), self._h, self._q + self._h / 2 * self._dq, self._dq
        due = self._due()
        if due is not self._stage:
            self._stage = due
            self._set(stored, dq)
        if self._ddq is None:
            self._ddq = self.acceleration(self._q, dq, law.ff0)
        stage = self._stage  # ahead: by how much the Coriolis torque grows in half a sub-step
        ahead = stage.truth.torques(self._q, dq + h / 2 * self._ddq, self._rest)
        ahead = ahead - stage.truth.torques(self._q, dq, self._rest)
        self.stopped, self._mass = False, None
        # Where nothing depends on the motion the state is only asked for at the tick's end.
        acting = len(self._rows) or self._wrenches or self._end_stops or len(self.obstacles)
        free = not acting and not law.kp.any() and not law.kd.any()
        motors = stage.arm, self._joints, bullet.TORQUE_CONTROL
        within = {"physicsClientId": stage.client}
        for i in range(self._substeps):
            part = (i + 0.5) / self._substeps
            ff = law.ff0 + part * (law.ff1 - law.ff0)
            rigid = self._reaching(t + part * PERIOD_S, stored, dq, law, ff, ahead)
            bullet.setJointMotorControlArray(*motors, forces=(rigid - ahead).tolist(), **within)
            bullet.stepSimulation(**within)
            if free and i < self._substeps - 1:
                continue
            states = bullet.getJointStates(stage.arm, self._joints, **within)
            both = np.array([state[:2] for state in states])
            stored, speed = both[:, 0].copy(), both[:, 1].copy()
            if len(self._bent):
                bend(self._rows, (dq + speed) / 2, h, self._bent)
            self._ddq, dq = (speed - dq) / (PERIOD_S if free else h), speed
        self._q, self._dq = stored - h / 2 * dq, dq
        self._ticks += 1

    def acceleration(self, q: Array, dq: Array, drive: Array) -> Array:
        """Joint acceleration (n,) rad/s² under driving torques `drive` (n,) N m."""
        parts = self._parts(q, dq, drive)
        M, bias = self.truth.mass_matrix(q), self.truth.torques(q, dq, self._rest)
        left = drive - parts[0] - friction(parts, dq) - bias
        M.flat[:: self._n + 1] += parts[4]
        return np.asarray(np.linalg.solve(M, left), float)

    def drive_for(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Driving torques (n,) N m that give the joint acceleration `ddq` (n,) rad/s²."""
        rigid = self.truth.torques(q, dq, ddq)
        parts = self._parts(q, dq, rigid)
        return np.asarray(rigid + parts[4] * ddq + parts[0] + friction(parts, dq))

    def close(self) -> None:
        """Free PyBullet's clients; may be called more than once."""
        self._close()

    def _now(self) -> float:
        return self._start_s + self._ticks * PERIOD_S

    def _due(self) -> ArmClient:
        """The stage of the tick that starts now."""
        now = self._now()
        return next(stage for stage in reversed(self._stages) if stage.start_s <= now)

    def _set(self, stored: Array, dq: Array) -> None:
        stage = self._stage
        for j, at, speed in zip(self._joints, stored.tolist(), dq.tolist(), strict=True):
            bullet.resetJointState(stage.arm, j, at, speed, physicsClientId=stage.client)

    def _parts(self, q: Array, dq: Array, rigid: Array) -> Array:
        """(5, n) of `add_up` now, contacts included."""
        parts = add_up(self._rows, self._now(), q, dq, rigid, self._bent)
        parts[0] -= self._contact(self._now(), q)
        return parts

    def _contact(self, t: float, q: Array) -> Array:
        """J^T wrench (n,) N m of what touches the last link at its origin."""
        torque = np.zeros(self._n)
        for start, end, wrench in self._wrenches:
            if start <= t < end:
                _, J = end_effector(self.truth.frames, q, np.eye(4))
                torque += J.T @ wrench
        return torque

    def _reaching(
        self, t: float, q: Array, dq: Array, law: DriveLaw, ff: Array, ahead: Array
    ) -> Array:
        """What of the drives' torques reaches the rigid arm in the next sub-step, (n,) N m.

        Args:
            t: the sub-step's middle, s; q: (n,) rad, the position there.
            dq: (n,) rad/s at its start.
            law: of the drives; ff: (n,) its feed-forward torque at the middle, N m.
            ahead: (n,) N m, growth of the Coriolis torque up to the middle.
        """
        beyond = q - np.minimum(np.maximum(q, self._lower), self._upper)
        touching = beyond != 0.0
        self.stopped |= bool(touching.any())
        push = law.kp * (law.q_des - q) + law.kd * law.dq_des + ff
        if not len(self._rows) and not law.kd.any() and not touching.any() and not self.obstacles:
            got = np.minimum(np.maximum(push, -law.most), law.most)
            return np.asarray(got + self._contact(t, q))
        stage = self._stage
        if self._mass is None:  # one for a whole tick: it changes little, and only dv hangs on it
            self._mass = stage.truth.mass_matrix(q)
        M, bias = self._mass.copy(), stage.truth.torques(q, dq, self._rest) + ahead
        ddq = self._rest if self._ddq is None else self._ddq
        middle = dq + self._h / 2 * ddq
        rigid = bias + M @ ddq
        parts = add_up(self._rows, t, q, middle, rigid, self._bent)
        # End stops, our choice, N m/rad: a falling arm (50 J) gives them 0.14 rad and rests there.
        parts[0] += 5000.0 * beyond - self._contact(t, q)
        parts[1] += 50.0 * touching  # N m s/rad
        if self.obstacles:
            against, damping = self.obstacles.act(t, q, middle, stage.truth.frames)
            parts[0] += against
            parts[1] += damping
        drive = np.array([push, law.kd, law.most])
        return np.asarray(step(M, bias, dq, self._h, parts, drive))
