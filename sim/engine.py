"""The arm's motion over one tick, by PyBullet, with every signal brought to its instant.

PyBullet steps by semi-implicit Euler: v' = v + h a(q, v), then q' = q + h v'. Read as it stands,
velocity and position are half a sub-step apart. Here the stored velocity is taken as that of the
stamp and the stored position as that of half a sub-step later: position Verlet, second order.
The torque that belongs to such a step is that of its middle, and the position at the stamp is
the stored one minus h/2 times the velocity. What is left is that PyBullet takes velocity-dependent
forces at the step's start; the change of the Coriolis torque over half a sub-step is added (left
out, it reads as a lag of 30 µs between torque and acceleration).
"""

from __future__ import annotations

import tempfile
import weakref
from pathlib import Path

import numpy as np
import pybullet as bullet

from sim.bare import make_bare
from sim.truth import Array, Truth
from sim.urdf_writer import payload_moments, urdf

PERIOD_S = 1e-3
SUBSTEPS = 4
H_S = PERIOD_S / SUBSTEPS  # 0.25 ms
MIDDLES = ((np.arange(SUBSTEPS) + 0.5) / SUBSTEPS)[:, None]  # of the sub-steps, in parts of a tick
COULOMB_WIDTH = 0.01  # rad/s: Fc sign(dq) is simulated as Fc tanh(dq / COULOMB_WIDTH)


class Engine:
    """The rigid body, its losses and its payloads; knows nothing of time or commands.

    Two PyBullet clients: one holds the arm that moves; the other one never steps and holds the
    arm once per payload stage, for mass matrix and inverse dynamics, which PyBullet caches per
    body and does not renew when a mass changes.
    """

    def __init__(self, truth: Truth) -> None:
        self._n = truth.n
        self._joints = list(range(truth.n))
        self._truth = truth
        self._lossy = bool(np.any([truth.Fv, truth.Fc, truth.motor_inertia]))
        self._world = bullet.connect(bullet.DIRECT)
        self._queries = bullet.connect(bullet.DIRECT)
        self._close = weakref.finalize(self, _disconnect, self._world, self._queries)
        self._arm = _load(truth, 0, self._world)
        self._stages = [_load(truth, k, self._queries) for k in range(1 + len(truth.events))]
        self._carried = 0
        self._q = self._dq = self._ddq = np.zeros(truth.n)
        self._prepare()

    def _prepare(self) -> None:
        """Switch off whatever PyBullet adds on its own account."""
        arm, world = self._arm, self._world
        make_bare(arm, world)
        bullet.setJointMotorControlArray(
            arm,
            self._joints,
            bullet.VELOCITY_CONTROL,
            forces=[0.0] * self._n,
            physicsClientId=world,
        )
        bullet.setTimeStep(H_S, physicsClientId=world)
        for client in (world, self._queries):
            bullet.setGravity(*self._truth.gravity.tolist(), physicsClientId=client)

    @property
    def truth(self) -> Truth:
        """The arm, payloads aside."""
        return self._truth

    def place(self, q: Array, dq: Array) -> None:
        """Put the arm at positions q (n,) rad with velocities dq (n,) rad/s."""
        for j, at, speed in zip(
            self._joints, (q + H_S / 2 * dq).tolist(), dq.tolist(), strict=True
        ):
            bullet.resetJointState(self._arm, j, at, speed, physicsClientId=self._world)
        self._q, self._dq, self._ddq = q, dq, np.zeros(self._n)

    def state(self) -> tuple[Array, Array]:
        """q (n,) rad and dq (n,) rad/s at the stamp."""
        return self._q, self._dq

    def tick(self, start: Array, end: Array) -> None:
        """Move on by one period, driving torque (n,) N m linear from `start` to `end`."""
        ahead = self._coriolis_ahead()
        for tau in start + MIDDLES * (end - start):
            rigid = self._through_the_drive(tau) if self._lossy else tau
            bullet.setJointMotorControlArray(
                self._arm,
                self._joints,
                bullet.TORQUE_CONTROL,
                forces=(rigid - ahead).tolist(),
                physicsClientId=self._world,
            )
            bullet.stepSimulation(physicsClientId=self._world)
        stored, dq = self._stored()
        self._ddq = (dq - self._dq) / PERIOD_S
        self._q, self._dq = stored - H_S / 2 * dq, dq

    def carry(self, count: int) -> None:
        """Let the last link carry the first `count` payload events from now on."""
        for k in range(self._carried, count):
            event = self._truth.events[k]
            bullet.changeDynamics(
                self._arm,
                self._n + k,
                mass=event.m,
                localInertiaDiagonal=payload_moments(event),
                physicsClientId=self._world,
            )
        self._carried = count

    def acceleration(self, q: Array, dq: Array, drive: Array) -> Array:
        """Joint acceleration (n,) rad/s² under driving torques `drive` (n,) N m."""
        M, bias = self._mass_matrix(q), self._rigid(q, dq, np.zeros(self._n))
        left = drive - self._friction(dq) - bias
        M.flat[:: self._n + 1] += self._truth.motor_inertia
        return np.asarray(np.linalg.solve(M, left), float)

    def drive_for(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Driving torques (n,) N m that give the joint acceleration `ddq` (n,) rad/s²."""
        return self._rigid(q, dq, ddq) + self._truth.motor_inertia * ddq + self._friction(dq)

    def close(self) -> None:
        """Free both PyBullet clients; may be called more than once."""
        self._close()

    def _stored(self) -> tuple[Array, Array]:
        states = bullet.getJointStates(self._arm, self._joints, physicsClientId=self._world)
        both = np.array([state[:2] for state in states])
        return both[:, 0], both[:, 1]

    def _friction(self, dq: Array) -> Array:
        return self._truth.Fv * dq + self._truth.Fc * np.tanh(dq / COULOMB_WIDTH)

    def _mass_matrix(self, q: Array) -> Array:
        """(n, n) of the rigid arm with its payload, kg m²."""
        stage = self._stages[self._carried]
        return np.array(
            bullet.calculateMassMatrix(stage, q.tolist(), physicsClientId=self._queries)
        )

    def _rigid(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Inverse dynamics (n,) N m of the rigid arm with its payload."""
        motion = q.tolist(), dq.tolist(), ddq.tolist()
        stage = self._stages[self._carried]
        return np.array(
            bullet.calculateInverseDynamics(stage, *motion, physicsClientId=self._queries)
        )

    def _coriolis_ahead(self) -> Array:
        """By how much the Coriolis torque (n,) N m grows in half a sub-step."""
        rest = np.zeros(self._n)
        middle = self._dq + H_S / 2 * self._ddq
        return self._rigid(self._q, middle, rest) - self._rigid(self._q, self._dq, rest)

    def _through_the_drive(self, tau: Array) -> Array:
        """What of a driving torque reaches the rigid arm in the next sub-step, (n,) N m.

        Friction at the middle of the step is f(v) + f'(v) dv / 2 with the dv that it itself
        allows: Coulomb friction smoothed over 0.01 rad/s is too stiff for an explicit step on
        joint 7 (f' h / M = 2). The motor's inertia takes its share of dv in the same equation.
        """
        truth = self._truth
        q, dq = self._stored()
        A, bias = self._mass_matrix(q), self._rigid(q, dq, np.zeros(self._n))
        sign = np.tanh(dq / COULOMB_WIDTH)
        friction = truth.Fv * dq + truth.Fc * sign
        slope = truth.Fv + truth.Fc / COULOMB_WIDTH * (1 - sign * sign)
        per_dv = truth.motor_inertia / H_S + slope / 2
        A /= H_S
        A.flat[:: self._n + 1] += per_dv
        dv = np.linalg.solve(A, tau - friction - bias)
        return tau - friction - per_dv * dv


def _load(truth: Truth, carried: int, client: int) -> int:
    """The arm as a PyBullet body with `carried` of its payloads; its number in the client."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(urdf(truth, carried), "utf-8")
        return bullet.loadURDF(
            str(path),
            useFixedBase=True,
            flags=bullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )


def _disconnect(*clients: int) -> None:
    for client in clients:
        if bullet.isConnected(physicsClientId=client):
            bullet.disconnect(physicsClientId=client)
