"""The arm's motion where effects act on it: friction of any kind, springs, contacts, changes.

Steps like `sim.engine` (position Verlet, everything at the middle of the sub-step) but keeps a
clock, since effects begin and end, and moves from one rigid arm to another where masses change.
"""

from __future__ import annotations

import weakref

import numpy as np
import pybullet as bullet

from sim.bare import make_bare
from sim.effect_forces import Losses, add_up, bend, losses_at, rows_of, step
from sim.effects import ENCODER, TORQUE, WRENCH
from sim.engine import PERIOD_S, SUBSTEPS
from sim.links import flange_torque
from sim.stages import Stage, load, rigid_truths
from sim.truth import Array, Truth

FORCES = ("fx", "fy", "fz", "mx", "my", "mz")


class EffectEngine:
    """The rigid body in its stages and all that acts on its joints; knows nothing of commands.

    Same methods as `sim.engine.Engine`; `carry` has nothing to do, payloads follow the clock.
    """

    def __init__(self, truth: Truth, period_s: float = PERIOD_S, substeps: int = SUBSTEPS) -> None:
        """Load the arm.

        Args:
            truth: arm and effects; those of the sensors are not this class's business.
            period_s: of a tick.
            substeps: of a tick.

        Raises:
            ValueError: a body that cannot be simulated.
        """
        self._n, self._period_s, self._substeps = truth.n, period_s, substeps
        self._h = period_s / substeps
        self._joints = list(range(truth.n))
        self._rows = rows_of(truth)
        self._bent = np.zeros(len(self._rows))
        self._wrenches = [
            (effect.start_s, effect.end_s, np.array([effect.number(key) for key in FORCES]))
            for effect in truth.effects
            if effect.place == WRENCH
        ]
        self._stages: list[Stage] = []
        clients: list[int] = []
        self._close = weakref.finalize(self, _disconnect, clients)
        for start_s, rigid in rigid_truths(truth, period_s):
            stage = load(start_s, rigid)
            clients.extend(stage.clients)
            self._stages.append(stage)
            _prepare(stage, truth.n, self._h)
        self._k, self._start_s = 0, 0.0
        self._stage = self._stages[0]
        self.place(np.zeros(truth.n), np.zeros(truth.n))

    @property
    def truth(self) -> Truth:
        """The rigid arm as it is at present."""
        return self._stage.truth

    def place(self, q: Array, dq: Array, t_s: float = 0.0) -> None:
        """Put the arm at q (n,) rad with dq (n,) rad/s at the time t_s."""
        self._k, self._start_s = 0, t_s
        self._stage = self._due()
        self._set(q + self._h / 2 * dq, dq)
        self._q, self._dq, self._ddq = q, dq, np.zeros(self._n)

    def state(self) -> tuple[Array, Array]:
        """q (n,) rad and dq (n,) rad/s of the links at the stamp."""
        return self._q, self._dq

    def tick(self, start: Array, end: Array) -> None:
        """Move on by one period, driving torque (n,) N m linear from `start` to `end`."""
        t, h, stored, dq = self._now(), self._h, self._q + self._h / 2 * self._dq, self._dq
        due = self._due()
        if due is not self._stage:
            self._stage = due
            self._set(stored, dq)
        if self._k == 0:
            self._ddq = self.acceleration(self._q, dq, start)
        stage, ahead = self._stage, self._coriolis_ahead()
        for i in range(self._substeps):
            part = (i + 0.5) / self._substeps
            now, tau = t + part * self._period_s, start + part * (end - start)
            rigid = self._reaching(now, stored, dq, tau, ahead)
            bullet.setJointMotorControlArray(
                stage.arm,
                self._joints,
                bullet.TORQUE_CONTROL,
                forces=(rigid - ahead).tolist(),
                physicsClientId=stage.client,
            )
            bullet.stepSimulation(physicsClientId=stage.client)
            states = bullet.getJointStates(stage.arm, self._joints, physicsClientId=stage.client)
            both = np.array([state[:2] for state in states])
            bend(self._rows, (dq + both[:, 1]) / 2, h, self._bent)
            stored, speed = both[:, 0].copy(), both[:, 1].copy()
            self._ddq, dq = (speed - dq) / h, speed
        self._q, self._dq = stored - h / 2 * dq, dq
        self._k += 1

    def carry(self, count: int) -> None:
        """Nothing: payloads come with the clock."""

    def acceleration(self, q: Array, dq: Array, drive: Array) -> Array:
        """Joint acceleration (n,) rad/s² under driving torques `drive` (n,) N m."""
        losses = self._losses(self._now(), q, dq, drive)
        M, bias = self._stage.mass_matrix(q), self._stage.rigid(q, dq, np.zeros(self._n))
        left = drive - losses.explicit - losses.friction(dq) - bias
        M.flat[:: self._n + 1] += losses.armature
        return np.asarray(np.linalg.solve(M, left), float)

    def drive_for(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Driving torques (n,) N m that give the joint acceleration `ddq` (n,) rad/s²."""
        rigid = self._stage.rigid(q, dq, ddq)
        losses = self._losses(self._now(), q, dq, rigid)
        return rigid + losses.armature * ddq + losses.explicit + losses.friction(dq)

    def close(self) -> None:
        """Free PyBullet's clients; may be called more than once."""
        self._close()

    def _now(self) -> float:
        return self._start_s + self._k * self._period_s

    def _due(self) -> Stage:
        """The stage of the tick that starts now."""
        now = self._now()
        return next(stage for stage in reversed(self._stages) if stage.start_s <= now)

    def _set(self, stored: Array, dq: Array) -> None:
        stage = self._stage
        for j, at, speed in zip(self._joints, stored.tolist(), dq.tolist(), strict=True):
            bullet.resetJointState(stage.arm, j, at, speed, physicsClientId=stage.client)

    def _losses(self, t: float, q: Array, dq: Array, rigid: Array) -> Losses:
        losses = losses_at(self._rows, t, q, dq, rigid, self._bent)
        losses.explicit[:] -= self._flange(t, q)
        return losses

    def _flange(self, t: float, q: Array) -> Array:
        """J^T wrench (n,) N m of what touches the flange."""
        torque = np.zeros(self._n)
        for start, end, wrench in self._wrenches:
            if start <= t < end:
                flange_torque(self._stage.truth.R, self._stage.truth.p, q, wrench, torque)
        return torque

    def _coriolis_ahead(self) -> Array:
        """By how much the Coriolis torque (n,) N m grows in half a sub-step."""
        rest, stage = np.zeros(self._n), self._stage
        middle = self._dq + self._h / 2 * self._ddq
        return stage.rigid(self._q, middle, rest) - stage.rigid(self._q, self._dq, rest)

    def _reaching(self, t: float, q: Array, dq: Array, tau: Array, ahead: Array) -> Array:
        """What of a driving torque (n,) reaches the rigid arm in the next sub-step, (n,) N m."""
        if not len(self._rows):
            return tau + self._flange(t, q) if self._wrenches else tau
        M, bias = self._stage.mass_matrix(q), self._stage.rigid(q, dq, np.zeros(self._n)) + ahead
        parts = np.zeros((5, self._n))
        middle = dq + self._h / 2 * self._ddq
        add_up(self._rows, t, q, middle, bias + M @ self._ddq, self._bent, parts)
        if self._wrenches:
            parts[0] -= self._flange(t, q)
        return np.asarray(step(M, bias, tau, dq, self._h, parts))


def acts_on_motion(truth: Truth) -> bool:
    """Whether a truth has effects that need this engine."""
    return any(effect.place not in (ENCODER, TORQUE) for effect in truth.effects)


def _prepare(stage: Stage, n: int, h: float) -> None:
    """Switch off whatever PyBullet adds on its own account."""
    arm, client = stage.arm, stage.client
    make_bare(arm, client)
    bullet.setJointMotorControlArray(
        arm, list(range(n)), bullet.VELOCITY_CONTROL, forces=[0.0] * n, physicsClientId=client
    )
    bullet.setTimeStep(h, physicsClientId=client)


def _disconnect(clients: list[int]) -> None:
    for client in clients:
        if bullet.isConnected(physicsClientId=client):
            bullet.disconnect(physicsClientId=client)
    clients.clear()
