"""Whether a step of a desired joint motion keeps the arm's limits."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sim.fci.codec import TICK_S
from sim.truth import Array, Limits

JERK_PER_ACCELERATION = 500.0  # 1/s: 7500 rad/s³ at 15 rad/s² (Franka FCI documentation)
# Differences over 1 ms of positions that the client had as f32 are off by up to 500 rad/s³
# (and 2e-4 rad/s), which a motion along its limits shall not be blamed for.
ROOM, SPEED_ROOM = 1.1, 1.001


class LimitErrors(NamedTuple):
    """What a kind of motion calls a limit that is not kept."""

    position: str
    velocity: str
    acceleration: str
    jerk: str


def broken(limits: Limits, errors: LimitErrors, q: Array, rates: tuple[Array, ...]) -> str | None:
    """The error of the first limit that is not kept; written so that a NaN keeps none.

    Args:
        limits: of the joints.
        errors: what to call it.
        q: (n,) rad; rates: dq, ddq at this tick and ddq at the one before, (n,) each.
    """
    dq, ddq, before = rates
    if not ((q >= limits.lower) & (q <= limits.upper)).all():
        return errors.position
    slowest, fastest = limits.speeds(q)
    if not ((dq >= slowest * SPEED_ROOM) & (dq <= fastest * SPEED_ROOM)).all():
        return errors.velocity
    most = limits.acceleration * ROOM
    if not (np.abs(ddq) <= most).all():
        return errors.acceleration
    if not (np.abs(ddq - before) <= JERK_PER_ACCELERATION * TICK_S * most).all():
        return errors.jerk
    return None
