"""Which rows of a recording are rows: where it pauses, and where a torque is not measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array

CUT_S, CUT_PERIODS = 0.15, 6.0  # without samples: what is longer, and of more periods, is a pause
# s, rad/s: a torque that stays so long while its joint moves is none, sooner at the end of its
# range; and longer than so many usual stays
STUCK_S, ENDS_S, STUCK_DQ, STUCK_TIMES = 0.3, 0.05, 0.05, 20.0


def pauses(t: Array) -> NDArray[np.int64]:
    """Rows of t (m,), s, behind which a recording pauses."""
    steps_s = np.diff(t)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    return np.flatnonzero(steps_s > max(CUT_S, CUT_PERIODS * usual_s))


def stuck(t: Array, dq: Array, tau: Array) -> NDArray[np.bool_]:
    """(m, n) where a torque is not measured: it never changes, or not for long in a motion.

    A value at the end of its range that it stays at so long is where the sensor ends: no reading
    of that value is a measured one. A reading that is never twice the same elsewhere tells so at
    rest, too.

    Args:
        t: (m,) s; dq, tau: (m, n) rad/s, N m.
    """
    out = np.zeros(tau.shape, dtype=bool)
    if len(t) < 2 or t[-1] - t[0] < STUCK_S or not (np.abs(dq) > STUCK_DQ).any():
        return out
    out[:] = np.ptp(tau, axis=0) == 0.0
    steps_s = np.diff(t)  # nobody knows what a torque was in a pause
    t = np.append(0.0, np.cumsum(np.minimum(steps_s, CUT_PERIODS * np.median(steps_s))))
    for j in np.flatnonzero(~out.all(axis=0)):
        x, edges = tau[:, j], np.flatnonzero(np.diff(tau[:, j])) + 1
        first, last = np.r_[0, edges], np.r_[edges, len(t)] - 1
        stays_s, ends = t[last] - t[first], np.isin(x[first], (x.min(), x.max()))
        long_s = np.where(ends, ENDS_S, STUCK_S)
        noisy = stays_s[~ends].max(initial=0.0) < ENDS_S
        for k in np.flatnonzero(stays_s > np.maximum(long_s, STUCK_TIMES * np.median(stays_s))):
            rows = slice(first[k], last[k] + 1)
            if (ends[k] and noisy) or np.median(np.abs(dq[rows, j])) > STUCK_DQ:
                out[rows, j] = True
                out[:, j] |= ends[k] & (x == x[first[k]])
    return out
