"""When samples were taken that a slower source gave to a faster, regular publisher.

A publisher at 30 Hz that shows the newest state of a source at 29.4 Hz stamps states that are up
to a period old, and every so often shows one twice. Its stamps are even, and the motion between
them is not: after a repeat the arm went as far in two periods as in one. The states themselves
are even, so they are numbered and spread over the time of the stamps. A repeat that stands for a
lost packet looks the same until the motion is asked: there the arm went on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array

FEWEST_SLIPS = 3  # of a source that is slower all along
SLIP_PERIODS = 0.5  # less motion than the stamps say, in median periods, is a state shown twice
BETTER = 0.5  # times the disagreement of dq and the steps of q that the stamps leave
FASTEST = 0.05  # share of the fastest step's speed below which a step's time is not told by motion

Stamps = NDArray[np.int64]


def source_stamps(stamp_ns: Stamps, q: Array, dq: Array) -> Stamps:
    """Stamps (m,) ns of the states themselves; the given ones where the motion agrees with them.

    Args:
        stamp_ns: (m,) ns, strictly increasing, of samples of which none repeats the last.
        q, dq: (m, n) rad, rad/s.
    """
    steps_s = 1e-9 * np.diff(stamp_ns)
    if len(steps_s) < FEWEST_SLIPS:
        return stamp_ns
    period_s = float(np.median(steps_s))
    went, speed = np.diff(q, axis=0), 0.5 * (dq[1:] + dq[:-1])
    size = np.sum(speed**2, axis=1)
    told = size > FASTEST**2 * size.max()
    took_s = np.sum(went * speed, axis=1)[told] / size[told]
    slips = np.flatnonzero(told)[took_s < steps_s[told] - SLIP_PERIODS * period_s]
    # what moves too little to be told from slips between is as the stamps say
    slips = slips[steps_s[slips] > (1.0 + SLIP_PERIODS) * period_s]
    if len(slips) < FEWEST_SLIPS:
        return stamp_ns
    ticks = np.maximum(np.round(steps_s / period_s), 1.0)
    ticks[slips] = np.maximum(ticks[slips] - 1.0, 1.0)
    numbers = np.concatenate([[0.0], np.cumsum(ticks)])
    span_ns = float(stamp_ns[-1] - stamp_ns[0])
    even = stamp_ns[0] + np.round(numbers * (span_ns / numbers[-1])).astype(np.int64)
    before, after = (
        float(np.sum((went - 1e-9 * np.diff(x)[:, None] * speed) ** 2)) for x in (stamp_ns, even)
    )
    return even if after < BETTER * before else stamp_ns
