"""Brings the joints' replies to the instant that the whole sample stands for. Pure.

Seven replies come one after the other, up to 0.7 ms apart. A sample stands for the instant at
which the requests of its tick were sent: each joint has measured once before it (its last tick's
reply) and once after it, so that every value lies between two measured ones. Straight lines do:
at 10 rad/s^2 a line over 1 ms is wrong by 1.3e-6 rad, against a quantum of 3.8e-4.

The measuring instant is not documented. It is taken as one reply's time on the wire before the
reply's arrival. A motor that measures when its request arrives, and then waits for the bus, did
so up to seven frames earlier; that shifts all joints by the same time and leaves their spread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

# stamp_ns, q, dq, tau
Reading = tuple[int, float, float, float]

NOTHING: Reading = (0, math.nan, math.nan, math.nan)


def at_instant(
    stamp_ns: int, before: Sequence[Reading], after: Sequence[Reading], reach_ns: int
) -> tuple[list[float], list[int]]:
    """All joints at `stamp_ns`.

    Args:
        stamp_ns: wanted.
        before, after: (n) the last two readings of each joint, in order of time.
        reach_ns: how far a prediction, and a line between two readings, may reach.

    Returns:
        (3 n) q, dq and tau, NaN where they cannot be said; joints without a reading at or after
        `stamp_ns`, whose motion is predicted and whose torque nobody measured.
    """
    q, dq, tau, missing = [], [], [], []
    for j, (t1, q1, dq1, tau1) in enumerate(after):
        ahead = stamp_ns - t1
        if -reach_ns <= ahead <= 0:
            t0, q0, dq0, tau0 = before[j]
            span = t1 - t0
            if span <= reach_ns and q0 == q0:
                share = ahead / span
                q.append(q1 + share * (q1 - q0))
                dq.append(dq1 + share * (dq1 - dq0))
                tau.append(tau1 + share * (tau1 - tau0))
            else:  # the first reply after a pause
                q.append(q1 + 1e-9 * ahead * dq1)
                dq.append(dq1)
                tau.append(tau1)
            continue
        missing.append(j)
        known = 0 < ahead <= reach_ns
        q.append(q1 + 1e-9 * ahead * dq1 if known else math.nan)
        dq.append(dq1 if known else math.nan)
        tau.append(math.nan)
    return q + dq + tau, missing
