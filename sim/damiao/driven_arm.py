"""The arm's motion under the motors' law, which is part of every sub-step.

A motor evaluates its law far more often than a millisecond. Its damping term is therefore taken
at the middle of the sub-step like friction in `sim.engine`: kd = 5 N m s/rad on a wrist joint of
0.005 kg m² would be unstable if it lagged by a tick.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pybullet as bullet

from sim.engine import COULOMB_WIDTH, H_S, MIDDLES, PERIOD_S, Engine
from sim.truth import Array, Truth

# End stops, our choice: a falling arm (50 J) gives them 0.14 rad and comes to rest there.
STOP_STIFFNESS = 5000.0  # N m/rad
STOP_DAMPING = 50.0  # N m s/rad


class Law(NamedTuple):
    """The motors' commands for one tick, (n,) each, in joint angles.

    Attributes:
        q_des, dq_des, kp, kd: rad, rad/s, N m/rad, N m s/rad.
        ff0: feed-forward torque at the start of the tick, N m.
        ff1: at its end; linear in between.
        most: limit of a motor's torque, N m; 0 for one that does not drive.
    """

    q_des: Array
    dq_des: Array
    kp: Array
    kd: Array
    ff0: Array
    ff1: Array
    most: Array


class DrivenArm(Engine):
    """The rigid body of `sim.engine`, driven by motor laws, with end stops and no brakes."""

    def __init__(self, truth: Truth) -> None:
        super().__init__(truth)
        self._lower, self._upper = truth.limits.lower, truth.limits.upper
        self.stopped = False

    def drive(self, law: Law) -> None:
        """Move on by one period. Sets `stopped`: an end stop was touched."""
        ahead = self._coriolis_ahead()
        inverse = None if self._lossy or not law.kd.any() else self._damped_inverse(law.kd)
        self.stopped = False
        for part in MIDDLES[:, 0]:
            tau = self._reaching(law, law.ff0 + part * (law.ff1 - law.ff0), inverse) - ahead
            bullet.setJointMotorControlArray(
                self._arm,
                self._joints,
                bullet.TORQUE_CONTROL,
                forces=tau.tolist(),
                physicsClientId=self._world,
            )
            bullet.stepSimulation(physicsClientId=self._world)
        stored, dq = self._stored()
        self._ddq = (dq - self._dq) / PERIOD_S
        self._q, self._dq = stored - H_S / 2 * dq, dq

    def _reaching(self, law: Law, ff: Array, inverse: Array | None) -> Array:
        """What of the motors' torques reaches the rigid arm in the next sub-step, (n,) N m.

        The position stored is that of the sub-step's middle; the velocity there is v + dv / 2.
        `inverse` is that of an arm without losses, None for one with losses or without damping.
        """
        q, v = self._stored()
        beyond = q - np.minimum(np.maximum(q, self._lower), self._upper)
        touching = beyond != 0.0
        tau = law.kp * (law.q_des - q) + law.kd * (law.dq_des - v) + ff
        if not touching.any() and not self._lossy:
            if inverse is None:
                return np.minimum(np.maximum(tau, -law.most), law.most)
            bias = self._rigid(q, v, np.zeros(self._n))
            got = np.asarray(tau - law.kd / 2 * (inverse @ (tau - bias)))
            if (np.abs(got) <= law.most).all():
                return got
        self.stopped |= bool(touching.any())
        stop_damping = STOP_DAMPING * touching
        rest = -self._friction(v) - STOP_STIFFNESS * beyond - stop_damping * v
        per_dv = self._losses_per_dv(v) + stop_damping / 2
        damping = law.kd / 2
        dv = self._speed_change(q, v, tau + rest, per_dv + damping)
        got = tau - damping * dv
        over = np.abs(got) > law.most
        if over.any():  # those joints get all that their motor has, whatever their speed
            damping = np.where(over, 0.0, damping)
            tau = np.where(over, np.sign(got) * law.most, tau)
            dv = self._speed_change(q, v, tau + rest, per_dv + damping)
            got = np.minimum(np.maximum(tau - damping * dv, -law.most), law.most)
        return np.asarray(got + rest - per_dv * dv)

    def _damped_inverse(self, kd: Array) -> Array:
        """(n, n) speed change per torque over a sub-step, under damping kd (n,).

        One for a whole tick: the mass matrix changes little in it, and only damping's share of
        a sub-step hangs on it.
        """
        A = self._mass_matrix(self._q) / H_S
        A.flat[:: self._n + 1] += kd / 2
        return np.asarray(np.linalg.inv(A), float)

    def _losses_per_dv(self, v: Array) -> Array:
        """How much torque (n,) friction and the motors' inertia take per change of speed."""
        truth = self._truth
        sign = np.tanh(v / COULOMB_WIDTH)
        slope = truth.Fv + truth.Fc / COULOMB_WIDTH * (1 - sign * sign)
        return np.asarray(truth.motor_inertia / H_S + slope / 2)

    def _speed_change(self, q: Array, v: Array, tau: Array, per_dv: Array) -> Array:
        """dv (n,) of the next sub-step under tau - per_dv dv."""
        A = self._mass_matrix(q) / H_S
        A.flat[:: self._n + 1] += per_dv
        return np.asarray(np.linalg.solve(A, tau - self._rigid(q, v, np.zeros(self._n))), float)
