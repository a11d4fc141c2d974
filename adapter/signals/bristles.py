"""How far bristles in the joints are bent (Dahl friction), sample by sample, from raw readings.

They depend on the way of a joint: z follows dz/dt = (dq - |dq| z) / s0. The noise of q and of dq
is a way too, of several mrad in a second, that would let z forget what it was at rest. So the way
is that of a place which follows dq at once and q slowly, and a way back counts only once it is
longer than noise is: until then the bristles bend as a spring does, and what is undone leaves no
trace. A joint that turns round and goes on loses nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from adapter.effects.by_joint import SMOOTHING_DQ, WAYS_RAD
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

PLACE_S = 0.05  # that the place takes to follow q: noise of both readings about evenly
BACK_RAD = 3.5e-4  # eight standard deviations of a place with a real Panda's noise
LONGEST_S = 0.02  # between two samples of one motion, whose velocity tells the way


class Bristles(NamedTuple):
    """Bristles of n joints over K ways.

    Attributes:
        place: (n,) rad, of now; NaN before the first sample.
        edge, direction: (n,) rad, and -1, 0 or 1: the farthest place on the way that it goes.
        held: (K, n) how far they are bent at the edge; nobody asks for those that slide at once.
    """

    place: Array
    edge: Array
    direction: Array
    held: Array


@jit
def wind(dt_s, q, dq, bristles, bent):
    """Take a sample q, dq (n,) that comes dt_s after the one before; fill bent (K n,)."""
    place, edge, direction, held = bristles
    n = q.shape[0]
    follow = 1.0 if dt_s > LONGEST_S else 1.0 - math.exp(-dt_s / PLACE_S)
    for j in range(q.shape[0]):
        if np.isnan(place[j]):
            place[j] = edge[j] = q[j]
        went = place[j] + (dq[j] * dt_s if follow < 1.0 else 0.0)
        place[j] = went + follow * (q[j] - went)
        way = place[j] - edge[j]
        to = np.sign(way)
        bent[j] = math.tanh(dq[j] / SMOOTHING_DQ)
        for k in range(1, held.shape[0]):
            bent[k * n + j] = to + (held[k, j] - to) * math.exp(-abs(way) / WAYS_RAD[k])
        if to == direction[j] or abs(way) > BACK_RAD:
            edge[j], direction[j] = place[j], to
            for k in range(held.shape[0]):
                held[k, j] = bent[k * n + j]
