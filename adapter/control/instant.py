"""Torques of joints beside the bodies at one instant, compiled.

Most effects of a joint (offset, friction, bristles, motor inertia, a spring) are linear in a few
columns that one instant shows. Which, and how much of each, is found by trying them
(`shares_of`): no effect has to say so, and what is something else is told apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum

import numpy as np

from adapter.effects.by_joint import SMOOTHING_DQ, WAYS_RAD, JointSignals, smooth_sign
from adapter.model.spatial import Array
from adapter.physics.kernels import JointMotion, inverse_dynamics, jit, link_motion
from adapter.signals.bristles import Bristles, wind

WAYS = len(WAYS_RAD)
COLUMNS = 5 + WAYS  # one, q, dq, its direction, ddq, how far bristles are bent
TRIED, ALIKE = 40, 1e-9  # instants; share by which the columns may be off


class Row(IntEnum):
    """Rows of the table of one model's joints, (n,) each."""

    Q = 0  # rad
    DQ = 1  # rad/s
    DDQ = 2  # rad/s²
    TAU = 3  # filled: torque, N m
    PLACE = 4  # of the bristles, as are the next ones
    EDGE = 5
    DIRECTION = 6
    HELD = 7
    BENT = 7 + WAYS
    SHARES = 7 + 2 * WAYS  # of the columns
    END = 7 + 2 * WAYS + COLUMNS


def joint_table(n: int) -> Array:
    """Of n joints without effects, whose bristles nobody has seen."""
    table = np.zeros((Row.END, n))
    table[Row.PLACE] = np.nan
    return table


def shares_of(torque: Callable[[JointSignals], Array | float], n: int) -> Array | None:
    """(COLUMNS, n) shares of which this torque of n joints consists; None where of none."""
    rng = np.random.default_rng(0)
    q, dq, ddq, tau = rng.uniform(-1.0, 1.0, (4, TRIED, n))
    dq *= np.abs(dq)  # slow ones, too, where the direction is no sign yet
    bent = rng.uniform(-1.0, 1.0, (WAYS, TRIED, n))
    said = np.array(np.broadcast_to(torque(JointSignals(q, dq, ddq, tau, bent=bent)), q.shape))
    columns = np.array([np.ones_like(q), q, dq, smooth_sign(dq), ddq, *bent]).transpose(2, 1, 0)
    shares = np.linalg.pinv(columns) @ said.T[..., None]
    off = np.abs((columns @ shares)[..., 0] - said.T).max()
    if not off <= ALIKE * max(1.0, float(np.abs(said).max())):
        return None
    return np.where(np.abs(shares) > ALIKE, shares, 0.0)[..., 0].T.copy()


@jit
def wind_table(table, dt_s):
    """Let the bristles of a table go along with its q and dq, dt_s after those before."""
    held, bent = table[Row.HELD.value : Row.BENT.value], table[Row.BENT.value : Row.SHARES.value]
    way = Bristles(table[Row.PLACE.value], table[Row.EDGE.value], table[Row.DIRECTION.value], held)
    wind(dt_s, table[Row.Q.value], table[Row.DQ.value], way, bent.reshape(-1))


@jit
def beside(table, j, bends):
    """Torque of joint j that the columns make, N m; as if nothing were bent unless it `bends`."""
    first, dq = Row.SHARES.value, table[Row.DQ.value, j]
    tau = table[first, j] + table[first + 1, j] * table[Row.Q.value, j] + table[first + 2, j] * dq
    tau += table[first + 3, j] * math.tanh(dq / SMOOTHING_DQ)
    tau += table[first + 4, j] * table[Row.DDQ.value, j]
    if bends:
        for k in range(WAYS):
            tau += table[first + 5 + k, j] * table[Row.BENT.value + k, j]
    return tau


@jit
def fill_torque(frames, theta, base, table, bends):
    """Fill `TAU` of a table: what its motion takes, bristles wound along it unless still.

    Args:
        frames: `Frames`; theta: (n, 10); base: (12,) motion row of the base.
        table: (END, n); bends: whether bristles go along, or nothing is bent.
    """
    joints = JointMotion(table[Row.Q.value], table[Row.DQ.value], table[Row.DDQ.value])
    if bends:
        wind_table(table, math.inf)
    motion = np.empty((table.shape[1], 12))
    link_motion(frames, joints, base, motion)
    inverse_dynamics(frames, theta, joints.q, motion, base, table[Row.TAU.value])
    for j in range(table.shape[1]):
        table[Row.TAU.value, j] += beside(table, j, bends)


def friction_of(table: Array, dq: float) -> Array:
    """(n,) N m: half of what turning from -dq to dq (rad/s) changes in it, far from the turn."""
    shares = table[Row.SHARES :]
    slide: Array = shares[2] * dq + shares[3] * smooth_sign(np.array(dq)) + shares[5:].sum(axis=0)
    return slide
