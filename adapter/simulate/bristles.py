"""How far the bristles in a simulated arm's joints are bent: they remember the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from adapter.effects.active import Active
from adapter.effects.bristle_friction import Rubs, bend
from adapter.effects.by_joint import smooth_sign
from adapter.model.spatial import Array


def with_bristles(effects: Sequence[Active]) -> list[Active]:
    """Those that have bristles."""
    return [a for a in effects if isinstance(a.effect, Rubs) and a.effect.bristles(a.values)]


class Bristles:
    """Those of b effects on n joints.

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
