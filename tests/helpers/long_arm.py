"""Long recordings: the documented Panda on a periodic motion, with friction, noise and changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adapter.effects.torque import ModelTorque
from adapter.model.inertia import theta_from_body
from adapter.model.robots import documented
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import Log

RATE_HZ = 1000
PERIOD_S = 20.0  # of the motion
SINES = (2, 5, 11)  # cycles in it
VISCOUS, DRY = 0.3, 0.6  # N m s/rad, N m
NOISE = (1e-5, 1e-3, 0.02)  # rad, rad/s, N m
SEED = 7
LOAD_KG, LOAD_AT_M, LOAD_SIZE = 1.0, (0.0, 0.0, 0.2), 2e-3  # in the last link's axes; kg m²
PUSH_N, PUSH_LASTS_S = (0.0, 15.0, 0.0), 3.0
DRIFTING, RISES_NM = 2, 0.3  # joint (from 0), N m over the whole recording


@dataclass(frozen=True)
class Hidden:
    """What happens in a recording of so many seconds besides friction.

    Attributes:
        holds: whether the hand holds LOAD_KG from the start, and puts it down where else it would
            pick it up.
    """

    seconds: float
    holds: bool = False

    @property
    def changed_s(self) -> float:
        """When the hand picks up LOAD_KG, or puts it down."""
        return round(2.0 * self.seconds / 3.0, 1) + 0.03

    @property
    def pushed_s(self) -> float:
        """When PUSH_N begins to act on the hand, for PUSH_LASTS_S."""
        return round(self.seconds / 3.0, 1) + 0.21

    @property
    def drift(self) -> float:
        """By how much the friction of joint DRIFTING rises, N m/s."""
        return RISES_NM / self.seconds


def rubs(dq: Array) -> Array:
    """Direction (m, 7) of dry friction."""
    return np.asarray(np.tanh(dq / 0.01))


def motion(seed: int = SEED) -> tuple[Array, Array, Array]:
    """q, dq, ddq (m, 7) of one period."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(PERIOD_S * RATE_HZ)) / RATE_HZ
    centre = np.array([0.0, -0.6, 0.0, -1.9, 0.0, 1.7, 0.7])  # rad, middle of the Panda's ranges
    q = np.tile(centre, (len(t), 1))
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    for cycles in SINES:
        w = 2.0 * np.pi * cycles / PERIOD_S
        # rad, of the slowest sine; the others by their frequency less
        size = 0.25 * SINES[0] / cycles * rng.uniform(0.6, 1.0, 7)
        phase = w * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 7)
        q += size * np.sin(phase)
        dq += size * w * np.cos(phase)
        ddq -= size * w**2 * np.sin(phase)
    return q, dq, ddq


def extra_torque(seed: int = SEED) -> tuple[Array, Array]:
    """(m, 7) N m of the load and of the push, along one period."""
    q, dq, ddq = motion(seed)
    model = documented("panda")
    theta = model.theta.copy()
    theta[-1] += theta_from_body(LOAD_KG, LOAD_AT_M, LOAD_SIZE * np.eye(3))
    loaded = ModelTorque(replace(model, theta=theta))(q, dq, ddq)
    arm = RigidArm.of(model)
    push = arm.wrench_torque(q, np.array([*PUSH_N, 0.0, 0.0, 0.0]))
    return loaded - ModelTorque(model)(q, dq, ddq), -push


def samples(
    seconds: float, hidden: Hidden | None = None, rate_hz: int = RATE_HZ, seed: int = SEED
) -> Iterator[tuple[Array, ...]]:
    """t, q, dq, tau of a recording of so many seconds, period by period."""
    rng, every = np.random.default_rng(seed), RATE_HZ // rate_hz
    q, dq, ddq = motion(seed)  # of one period, without noise
    tau = ModelTorque(documented("panda"))(q, dq, ddq) + VISCOUS * dq + DRY * rubs(dq)
    tables = tuple(x[::every] for x in (q, dq, tau))
    load, push = (x[::every] for x in extra_torque(seed))
    for first in range(0, round(seconds * rate_hz), len(load)):
        rows = min(len(load), round(seconds * rate_hz) - first)
        t = (first + np.arange(rows)) / rate_hz
        q, dq, tau = (
            x[:rows] + s * rng.standard_normal((rows, 7))
            for x, s in zip(tables, NOISE, strict=True)
        )
        if hidden is not None:
            held = (t < hidden.changed_s) if hidden.holds else (t >= hidden.changed_s)
            tau[held] += load[:rows][held]
            pushed = (t >= hidden.pushed_s) & (t < hidden.pushed_s + PUSH_LASTS_S)
            tau[pushed] += push[:rows][pushed]
            tau[:, DRIFTING] += hidden.drift * t * rubs(tables[1][:rows, DRIFTING])
        yield t, q, dq, tau


def log_of(
    seconds: float, hidden: Hidden | None = None, rate_hz: int = RATE_HZ, seed: int = SEED
) -> Log:
    """The recording in memory."""
    parts = zip(*samples(seconds, hidden, rate_hz, seed), strict=True)
    t, q, dq, tau = (np.concatenate(x) for x in parts)
    names = documented("panda").tree.joint_names
    return Log(Path("made.mcap"), names, np.round(1e9 * t).astype(np.int64) + 1, q, dq, tau)
