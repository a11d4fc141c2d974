"""Logs of an arm of six joints whose drives report currents: Pinocchio's torques over gains.

The Panda with its last joint locked, inertias off in all and link by link, a gearbox's friction
with 10 % of noise, gains of 8 to 15 N m/A. Nothing here is the adapter's but the log's record.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from adapter.model.locking import locked
from adapter.model.self_model import SelfModel
from drivers.files.mcap import Log
from sim.effects import payload
from sim.truth import Truth
from tests.helpers.arm_data import Motion, arm, panda_model, pin_model, rnea, trajectory

JOINTS = 6
LOAD_KG = 3.0
EVERY = 4  # 250 Hz


@dataclass(frozen=True, eq=False)
class DrivenArm:
    """Hidden: gains (6,) N m/A; Fc, Fv (6,) of the gearboxes; arm; the factor of all masses."""

    gain: np.ndarray
    Fc: np.ndarray
    Fv: np.ndarray
    truth: Truth
    scale: float


@cache
def six_joints() -> SelfModel:
    """The documented arm."""
    return locked(panda_model(), {"panda_joint7": 0.0})


def driven_arm(seed: int, spread: float = 0.05) -> DrivenArm:
    """An arm whose masses are off by 15 % in all at most, and by a spread link by link.

    No link weighs less than a fifth: without mass there is no centre, and torques of 1e24 N m.
    """
    rng = np.random.default_rng([seed, 15])
    scale = rng.uniform(0.85, 1.15)
    theta = scale * arm().theta * np.maximum(rng.normal(1.0, spread, (7, 1)), 0.2)
    theta[:, 1:4] *= rng.normal(1.0, spread, (7, 3))
    size = np.array([4.0, 5.0, 4.0, 3.0, 1.5, 1.5])  # N m, of gearboxes
    return DrivenArm(
        rng.uniform(8.0, 15.0, JOINTS),
        size * rng.uniform(0.5, 1.5, JOINTS),
        size * rng.uniform(0.5, 1.5, JOINTS),
        arm().with_changes(theta=theta),
        float(scale),
    )


def currents(hidden: DrivenArm, seed: int, seconds: float = 20.0, load_kg: float = 0.0) -> Log:
    """A log of it in A, the hand with a load or bare."""
    rng = np.random.default_rng([seed, 16])
    q, dq, ddq = (x[::EVERY].copy() for x in trajectory(Motion(seconds, seed)))
    q[:, 6], dq[:, 6], ddq[:, 6] = 0.0, 0.0, 0.0
    com = np.array([0.05, -0.03, 0.107 + 0.08])
    held = payload(load_kg, com, 0.004 * np.eye(3)) if load_kg else None
    tau = rnea(pin_model(hidden.truth, held), q, dq, ddq)[:, :JOINTS]
    q, dq = q[:, :JOINTS], dq[:, :JOINTS]
    rough = 0.1 * rng.normal(size=q.shape)
    friction = hidden.Fc * np.tanh(dq / 0.01) + hidden.Fv * dq
    effort = (tau + friction * (1.0 + rough)) / hidden.gain
    stamps = 1_000_000 * EVERY * np.arange(len(q), dtype=np.int64)
    noise = (rng.normal(size=q.shape) for _ in range(3))
    signals = (
        x + level * e
        for x, level, e in zip((q, dq, effort), (3e-5, 3e-3, 0.02), noise, strict=True)
    )
    name = "loaded" if load_kg else "bare"
    return Log(Path(f"{name}_{seed}.mcap"), arm().joint_names[:JOINTS], stamps, *signals)
