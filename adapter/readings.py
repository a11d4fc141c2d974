"""Which joint readings a controller may act upon."""

from __future__ import annotations

import math

import numpy as np

from adapter.fast import jit
from adapter.records import Array

# What an honest reading keeps between two samples. A jump that stays below the first two moves
# the spring of a stiff joint (600 N m/rad) by 3 N m.
JUMP = 0.005  # rad, beyond what the measured speeds say: noise, steps of the encoder
DRIFT = 0.25  # of the documented speed, by which the measured one may be wrong or late
FASTER = 1.5  # of the documented speed is more than a joint does
HARDER = 100.0  # rad/s² is more than an arm does, five times what a Panda may
STUCK_EFFORT = 0.1  # of the effort limit that the spring winds up on a reading that stands still
STUCK_WAY = 0.02  # rad that the measured speed makes meanwhile

GOOD, NON_FINITE, JUMPED, STUCK = 0, 1, 2, 3


@jit
def judge_reading(q, dq, q_ref, least_s, most_s, velocity, wind, last_q, last_dq, since_ref, way):
    """(verdict, joint) on a reading; the last four arguments are overwritten if it is good.

    Args:
        q, dq: (n,) the reading; q_ref: (n,) the reference.
        least_s, most_s: time since the last good reading lies between these.
        velocity: (n,) documented, rad/s; wind: (n,) how far the reference may move while the
            reading stays the same to the last bit, rad.
        last_q, last_dq: (n,) the last good reading; NaN before the first.
        since_ref: (n,) the reference when q changed at last.
        way: (n,) rad that the measured speed has made since then.
    """
    n = q.shape[0]
    for j in range(n):
        if not (math.isfinite(q[j]) and math.isfinite(dq[j])):
            return 1, j
    for j in range(n):
        if not math.isfinite(last_q[j]):
            continue
        moved = q[j] - last_q[j]
        speed = 0.5 * (dq[j] + last_dq[j])
        low, high = min(speed * least_s, speed * most_s), max(speed * least_s, speed * most_s)
        room = JUMP + DRIFT * velocity[j] * most_s
        if abs(dq[j]) > FASTER * velocity[j]:
            return 2, j
        if abs(dq[j] - last_dq[j]) > DRIFT * velocity[j] + HARDER * most_s:
            return 2, j
        if abs(moved) > JUMP + FASTER * velocity[j] * most_s:
            return 2, j
        if moved < low - room or moved > high + room:
            return 2, j
    for j in range(n):
        if q[j] != last_q[j]:
            continue
        if abs(q_ref[j] - since_ref[j]) > wind[j] or abs(way[j] + dq[j] * least_s) > STUCK_WAY:
            return 3, j
    for j in range(n):
        if q[j] != last_q[j]:
            since_ref[j], way[j] = q_ref[j], 0.0
        else:
            way[j] += dq[j] * least_s
        last_q[j], last_dq[j] = q[j], dq[j]
    return 0, 0


class Readings:
    """Judges readings one after the other.

    Args:
        velocity: (n,) documented speeds, rad/s.
        effort: (n,) limits, N m (may be infinite); stiffness: (n,) of the controller, N m/rad.

    Attributes:
        joint: index of the joint that the last verdict is about.
    """

    def __init__(self, velocity: Array, effort: Array, stiffness: Array) -> None:
        n = len(velocity)
        self._velocity = np.array(velocity, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            wind = STUCK_EFFORT * np.asarray(effort) / stiffness
        self._wind = np.where(np.isfinite(wind), wind, np.inf)
        self._q, self._dq, self._since = (np.full(n, np.nan) for _ in range(3))
        self._way = np.zeros(n)
        self.joint = 0

    def judge(self, q: Array, dq: Array, q_ref: Array, least_s: float, most_s: float) -> int:
        """GOOD, NON_FINITE, JUMPED or STUCK.

        Args:
            q, dq: (n,) the reading; q_ref: (n,) the reference.
            least_s, most_s: time since the last good reading lies between these.
        """
        verdict, self.joint = judge_reading(
            q,
            dq,
            q_ref,
            least_s,
            most_s,
            self._velocity,
            self._wind,
            self._q,
            self._dq,
            self._since,
            self._way,
        )
        return int(verdict)
