"""Friction with a memory in every joint of a simulated arm; of another shape than any learner's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.hidden.sizes import WRIST, WRIST_SHARE, log_uniform
from sim.truth import Array

COULOMB, VISCOUS = (0.2, 1.0), (0.05, 0.5)  # N m, N m s/rad
STICTION, STRIBECK_SPEED = (1.0, 1.6), (0.02, 0.1)  # of Coulomb's; rad/s
BRISTLE_RAD = (0.3e-3, 4e-3)  # over which a joint winds up


@dataclass(frozen=True, eq=False)
class Bristles:
    """LuGre's friction (Canudas de Wit et al. 1995), without damping of the bristles.

    Attributes:
        coulomb, stiction, speed, viscous, deflection: (n,) N m, N m, rad/s, N m s/rad, rad.
        start: (n,) deflection at the first sample, of the largest.
    """

    coulomb: Array
    stiction: Array
    speed: Array
    viscous: Array
    deflection: Array
    start: Array

    def along(self, dq: Array, step_s: float) -> Array:
        """Torque (m, n) N m along joint velocities (m, n)."""
        out, z = np.empty_like(dq), self.start * self.coulomb
        for k, v in enumerate(dq):
            z = self.after(z, v, step_s)
            out[k] = z + self.viscous * v
        return out

    def after(self, z: Array, v: Array, step_s: float) -> Array:
        """Torque (n,) of the bristles a step at velocity v (n,) later: exact for a constant v."""
        level = self.coulomb + (self.stiction - self.coulomb) * np.exp(-np.square(v / self.speed))
        rate = np.abs(v) * self.coulomb / (self.deflection * level)
        end = np.sign(v) * level
        return np.asarray(end + (z - end) * np.exp(-rate * step_s))


def draw_bristles(rng: np.random.Generator, n: int) -> Bristles:
    """Of n joints; WRIST_SHARE of the torques from joint WRIST (from 1) on."""
    share = np.where(np.arange(1, n + 1) >= WRIST, WRIST_SHARE, 1.0)
    coulomb = share * sizes(rng, COULOMB, n)
    return Bristles(
        coulomb,
        coulomb * rng.uniform(*STICTION, n),
        rng.uniform(*STRIBECK_SPEED, n),
        share * sizes(rng, VISCOUS, n),
        sizes(rng, BRISTLE_RAD, n),
        rng.uniform(-1, 1, n),
    )


def sizes(rng: np.random.Generator, span: tuple[float, float], n: int) -> Array:
    """(n,) sizes from a span, all orders of magnitude alike."""
    return np.array([log_uniform(rng, span) for _ in range(n)])
