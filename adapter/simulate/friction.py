"""What friction does in a step: what is stiff is solved for, and bristles remember the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from adapter.effects.active import Active
from adapter.effects.bristle_friction import Rubs, bend
from adapter.effects.by_joint import SMOOTHING_DQ, smooth_sign
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

ROUNDS = 60
DONE = 1e-10  # rad/s
ENOUGH = 1e-4  # share of the expected descent that a step must bring


@jit
def speed_change(M, push, v, losses, h):
    """Change of speed dv (n,) rad/s and the speed (n,) at which friction acts in a step of h (s).

    Solves M dv = h (push - f(v + share dv)), f(u) = viscous u + level tanh(u / SMOOTHING_DQ), by
    Newton's method on the convex function whose gradient that is. The share is one half (second
    order) where friction is not stiff, and goes to one where it is: with the friction of the
    step's start, or of its middle, a joint would swing about its standstill.

    Args:
        M: (n, n) mass matrix with what turns with the joints, kg m².
        push: (n,) all other torques, N m.
        v: (n,) speed at the start, rad/s.
        losses: (3, n) viscous, N m s/rad, level forwards and backwards, N m; none negative.
    """
    n = v.shape[0]
    dv, share, step = np.zeros(n), np.empty(n), np.empty(n)
    gradient, hessian = np.empty(n), np.empty((n, n))
    for i in range(n):
        stiff = (losses[0, i] + max(losses[1, i], losses[2, i]) / SMOOTHING_DQ) * h / M[i, i]
        share[i] = max(0.5, 1.0 - 1.0 / max(stiff, 1.0))
    cost = _cost(M, h * push, v, (losses, share, h), dv)
    for _ in range(ROUNDS):
        gradient[:] = M @ dv - h * push
        hessian[:] = M
        for i in range(n):
            u = v[i] + share[i] * dv[i]
            level = losses[1, i] if u > 0.0 else losses[2, i]
            s = np.tanh(u / SMOOTHING_DQ)
            slope = losses[0, i] + level / SMOOTHING_DQ * (1.0 - s * s)
            gradient[i] += h * (losses[0, i] * u + level * s)
            hessian[i, i] += h * share[i] * slope
        step[:] = np.linalg.solve(hessian, -gradient)
        descent = gradient @ step
        new = _cost(M, h * push, v, (losses, share, h), dv + step)
        while new > cost + ENOUGH * descent and np.abs(step).max() > DONE:
            step *= 0.5
            descent *= 0.5
            new = _cost(M, h * push, v, (losses, share, h), dv + step)
        dv += step
        cost = new
        if np.abs(step).max() < DONE:
            break
    return dv, v + share * dv


@jit
def _cost(M, kick, v, friction, dv):
    """dv'M dv / 2 - kick dv + h times the potential of the losses."""
    losses, share, h = friction
    total = 0.5 * dv @ (M @ dv) - kick @ dv
    for i in range(v.shape[0]):
        u = v[i] + share[i] * dv[i]
        level = losses[1, i] if u > 0.0 else losses[2, i]
        x = abs(u) / SMOOTHING_DQ
        dry = level * SMOOTHING_DQ * (x + np.log1p(np.exp(-2.0 * x)) - np.log(2.0))
        total += h / share[i] * (0.5 * losses[0, i] * u * u + dry)
    return total


def with_bristles(effects: Sequence[Active]) -> list[Active]:
    """Those that have bristles."""
    return [a for a in effects if isinstance(a.effect, Rubs) and a.effect.bristles(a.values)]


class Bristles:
    """How far the bristles of b effects on n joints are bent: they remember the way.

    Args:
        effects: of which those that have bristles count.
        n: joints.
        period_s: of a step. What is so stiff that a step cannot follow it is taken as softer; at
            1 ms and 3 g m² that is a way below 0.1 mrad for 0.3 N m.

    Attributes:
        effects: those with bristles.
    """

    def __init__(self, effects: Sequence[Active], n: int, period_s: float) -> None:
        self.effects, self._n, self._period_s = with_bristles(effects), n, period_s
        self._joint = [active.joint for active in self.effects]
        self._way = np.array([a.values["s0"] for a in self.effects], dtype=float)
        self._kinds: list[tuple[Rubs, list[int], dict[str, Array]]] = []
        for effect in dict.fromkeys(cast(Rubs, a.effect) for a in self.effects):
            own = [k for k, a in enumerate(self.effects) if a.effect is effect]
            numbers = [self.effects[k].values for k in own]
            values = {key: np.array([x[key] for x in numbers], dtype=float) for key in numbers[0]}
            self._kinds.append((effect, own, values))
        self._most = self._levels(np.zeros(len(self.effects)))
        self._along: tuple[Array, Array] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget how far they are bent: as far as they are where the joint slides as it moves."""
        self._at: Array | None = None
        self._z = np.zeros(len(self.effects))

    def follow(self, t: Array, q: Array, dq: Array) -> None:
        """Remember a recorded motion (m, n) at t (m,) s, from which `settle` starts."""
        if self.effects:
            z, bent = smooth_sign(dq[0, self._joint]), np.empty((len(t), len(self._way)))
            steps = np.diff(q[:, self._joint], axis=0, prepend=q[:1, self._joint])
            bend(steps, self._way, z, bent)
            self._along = t, bent

    def settle(self, t: float, q: Array) -> None:
        """Start at the joint angles q (n,) as the recorded motion left them at t (s)."""
        if self._along is not None:
            times, bent = self._along
            self._at = q.copy()
            self._z = bent[min(int(np.searchsorted(times, t - 1e-9)), len(times) - 1)].copy()

    def torque(self, q: Array, dq: Array, mass: Array, acting: Sequence[Active]) -> Array:
        """Torque (n,) N m at the joint angles q (n,), to which the joints went straight.

        Args:
            q, dq: (n,) rad, rad/s.
            mass: (n, n) kg m².
            acting: effects that do act; the others are bent all the same.
        """
        out = np.zeros(self._n)
        if not self.effects:
            return out
        if self._at is None:
            self._at, self._z = q.copy(), smooth_sign(dq[self._joint])
        light = 1.0 / np.diag(np.linalg.inv(mass))[self._joint]
        way = np.maximum(self._way, self._most * self._period_s**2 / light)
        bend((q - self._at)[None, self._joint], way, self._z, np.empty((1, len(way))))
        self._at = q.copy()
        on = [active in acting for active in self.effects]
        np.add.at(out, self._joint, self._levels(dq[self._joint]) * self._z * on)
        return out

    def _levels(self, dq: Array) -> Array:
        """(b,) N m at which they slide at dq (b,), rad/s."""
        out = np.empty(len(dq))
        for effect, own, values in self._kinds:
            out[own] = effect.level(dq[own], values)
        return out
