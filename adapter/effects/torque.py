"""Torque of a self model with its effects: what its sensors would read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from adapter.effects.active import Active, active_effects, lasting_effects
from adapter.effects.base import (
    SMOOTH_HZ,
    ArmDynamics,
    BodyEffect,
    Motion,
    MotionEffect,
    SensorEffect,
    TorqueEffect,
)
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm

RATES_HZ = 2.0 * SMOOTH_HZ  # above it, rates of torques are taken as noise of the motion


def sensed_torque(motion: Motion, effects: Sequence[Active]) -> Array:
    """tau (m, n) that the sensors would read, stage by stage (see `effects.base`)."""
    motion = moved_links(motion, effects)
    tau = bodies(motion, effects)
    return sensors(motion, added(motion, tau, effects), effects)


def moved_links(motion: Motion, effects: Sequence[Active], tau: Array | None = None) -> Motion:
    """Stage 1: motion of the links behind the measured one.

    The gears are twisted by `tau` (m, n) N m; by the rigid torque where None.
    """
    guess = tau
    for active in effects:
        if isinstance(active.effect, MotionEffect):
            if guess is None:
                guess = bodies(motion, effects)
            moved = active.effect.link_side(motion, guess, active.joint, active.values)
            on = active.on(motion.t)
            if on is not None:
                pairs = {k: (getattr(moved, k), getattr(motion, k)) for k in ("q", "dq", "ddq")}
                tables = {k: np.where(on[:, None], *pair) for k, pair in pairs.items()}
                moved = replace(motion, **tables)
            motion = moved
    return motion


def bodies(motion: Motion, effects: Sequence[Active]) -> Array:
    """Stage 2: rigid torque (m, n) with the bodies and the gravity of every instant."""
    own = [active for active in effects if isinstance(active.effect, BodyEffect)]
    switches = sorted({t for active in own for t in active.interval_s if np.isfinite(t)})
    tau = np.empty_like(motion.q)
    cuts = [0, *np.searchsorted(motion.t, switches), len(motion.t)]
    spans = pairwise([-np.inf, *switches, np.inf])
    for (begin, end), (first, last) in zip(spans, pairwise(cuts), strict=True):
        if first < last:
            arm, part = arm_between(motion.arm, own, begin, end), slice(first, last)
            tau[part] = arm.torque(motion.q[part], motion.dq[part], motion.ddq[part])
    return tau


def arm_between(
    arm: ArmDynamics, effects: Sequence[Active], begin_s: float, end_s: float
) -> ArmDynamics:
    """The arm with those effects on its bodies that act all the time between two instants."""
    theta, gravity = arm.theta, arm.gravity
    for active in effects:
        whole = active.interval_s[0] <= begin_s and end_s <= active.interval_s[1]
        if isinstance(active.effect, BodyEffect) and whole:
            theta, gravity = active.effect.body(theta, gravity, active.joint, active.values)
    return arm.changed(theta, gravity)


def added(motion: Motion, tau: Array, effects: Sequence[Active]) -> Array:
    """Stage 3: rigid torque (m, n) with what acts at the joints."""
    total = tau.copy()
    for active in effects:
        if isinstance(active.effect, TorqueEffect) and not active.effect.after_sensors:
            own, begin = motion, active.interval_s[0]
            if begin > -np.inf:  # what changes with time counts from the effect's own start
                own = replace(motion, t=motion.t - begin)
            extra = active.effect.torque(own, tau, active.joint, active.values)
            on = active.on(motion.t)
            total += extra if on is None else extra * on[:, None]
    return total


def sensors(motion: Motion, tau: Array, effects: Sequence[Active]) -> Array:
    """Stage 4: what the torque sensors make of torques (m, n)."""
    for active in effects:
        if isinstance(active.effect, SensorEffect):
            read = active.effect.measured(motion, tau, active.joint, active.values)
            on = active.on(motion.t)
            tau = read if on is None else np.where(on[:, None], read, tau)
    for active in effects:  # a sensor's offset is added to whatever else it does
        if isinstance(active.effect, TorqueEffect) and active.effect.after_sensors:
            extra = active.effect.torque(motion, tau, active.joint, active.values)
            on = active.on(motion.t)
            tau = tau + (extra if on is None else extra * on[:, None])
    return tau


class ModelTorque:
    """Inverse dynamics of a self model's joints with its tool and its effects.

    Args:
        model: whose λ, θ, tool, gravity and effects are used.
        base: (m, 12) motion of its base, for tables of those m samples; None where it rests.
        own_log: whether motions are of the recording that the model's intervals are of: each
            effect acts in its own. Else those act that have no end, all the time.
    """

    def __init__(self, model: SelfModel, base: Array | None = None, own_log: bool = False) -> None:
        arm = RigidArm.of(model)
        self._arm = arm if base is None else arm.moving(base)
        acting = active_effects if own_log else lasting_effects
        self._effects = acting(model.effects, model.tree.n)

    def __call__(
        self, q: Array, dq: Array, ddq: Array, t: Array | None = None, sharp_q: Array | None = None
    ) -> Array:
        """tau (m, n), N m, for q, dq, ddq (m, n) rad, rad/s, rad/s².

        With `t` (m,), s since the recording began, increasing, the rows are one motion: sensors
        lag, gears twist, bristles wind up as it goes on. Without it each row is an instant by
        itself: sensors have settled, bristles are bent the way the joint moves, nothing drifts.
        Where a joint jumps, the motion is taken as smooth as the recipe of `signals.validation`
        makes it; `sharp_q` (m, n), rad, are angles that were smoothed less, if at all.
        """
        t = np.zeros(len(q)) if t is None else t
        bands = np.full(q.shape[1], RATES_HZ)
        motion = Motion(t, q, dq, ddq, self._arm, bands, SMOOTH_HZ, sharp_q)
        return sensed_torque(motion, self._effects)
