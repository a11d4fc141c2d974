"""When a reply was measured, and what all joints were at one instant. Pure.

Arrivals are told on CLOCK_MONOTONIC. Interfaces stamp frames with the wall clock, which may be
set forward or back at any time, or with a clock of their own (some USB adapters count from
power-up). An arrival that cannot be, because it lies before the bus was last emptied or after
now, is taken at its word no longer.

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

SLACK_NS = 2_000  # stamps are floats, 0.24 us apart, and the two clocks are read one by one
# stamp_ns, q, dq, tau
Reading = tuple[int, float, float, float]
NOTHING: Reading = (0, math.nan, math.nan, math.nan)


class ArrivalClock:
    """Turns stamps of frames into arrival instants.

    Attributes:
        own_clock: the interface does not stamp with the wall clock.
        replaced: arrivals for which no stamp could be used.
        first_ns, now_ns, offset_ns: of this batch: an arrival lies between the former two, and
            is the stamp plus the latter where the interface stamps with the wall clock.
    """

    def __init__(self) -> None:
        self.own_clock = False
        self.replaced = 0
        self.first_ns = self.now_ns = self.offset_ns = 0
        self._looked_ns = self._offset_before_ns = 0
        self._least_ns: float | None = None
        self._impossible = self._replaced_before = 0

    def begin(self, looked_ns: int, now_ns: int, wall_ns: int) -> None:
        """A batch of frames was taken.

        Args:
            looked_ns: before the bus was looked at; what this batch left behind came later.
            now_ns, wall_ns: both clocks after it.
        """
        if self.replaced == self._replaced_before:
            self._impossible = 0
        self._replaced_before = self.replaced
        if self._least_ns is not None:
            self._least_ns += 1e-4 * (now_ns - self.now_ns)  # forgotten by 100 ppm
        self.first_ns, self._looked_ns, self.now_ns = self._looked_ns - SLACK_NS, looked_ns, now_ns
        self._offset_before_ns, self.offset_ns = self.offset_ns, now_ns - wall_ns

    def unusual(self, stamp_s: float) -> int:
        """CLOCK_MONOTONIC instant, ns, between the last batch and this one, of an arrival whose
        stamp the wall clock does not explain.
        """
        stamp_ns = int(1e9 * stamp_s)
        first, now = self.first_ns, self.now_ns
        if not self.own_clock:
            at = stamp_ns + self.offset_ns
            if now < at <= now + SLACK_NS:
                return now
            at = stamp_ns + self._offset_before_ns  # the wall clock was set in between
            if first <= at <= now:
                return at
            self._impossible += 1
            self.own_clock = self._impossible > 50  # in a row
            self.replaced += 1
            return now
        offset = float(now - stamp_ns)
        if self._least_ns is None or offset < self._least_ns:
            self._least_ns = offset
        at = stamp_ns + int(self._least_ns)
        if first <= at <= now:
            return at
        self._least_ns = None  # it was set, or wrapped around
        self.replaced += 1
        return now


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
