"""How far an arm's time goes from sample to sample, from stamps that may lie."""

from __future__ import annotations

RESYNC_AFTER = 5  # stamps in a row that lie before the newest one: the clock was set back
CLEAR = 0.35  # of a period: nearer than this to a tick, an instant belongs to it
AWAY = 20  # periods beyond what the stamps say: the loop was away, or a simulated arm stood still
FOLLOW = 16  # the ticks follow the instants by one part in so many


class SampleClock:
    """Turns stamps into steps of time that never go back and never leap.

    By stamps alone, a stamp that repeats, or lies before the newest, is a step of nothing; one
    that leaps further than `longest_ns` is a step of one period, since a clock that was set looks
    like that. Where the instants at which samples are handled are told as well, these decide in
    whole periods, since nobody sets that clock: it tells a hole from a leap. An instant halfway
    between two ticks leaves the choice between them to the stamp, and so does one much later than
    a stamp that follows its predecessor: no sample is missing, nobody was there to take it.

    Args:
        period_ns: of the arm.
        longest_ns: longest step of the stamps that is believed.

    Attributes:
        fresh: the last stamp was newer than those before it.
        stamp_step_ns: the last step by the stamps alone.
        leapt: the last stamp was further ahead than is believed.
        clock_step_ns: since the last call by the instants alone.
    """

    def __init__(self, period_ns: int, longest_ns: int) -> None:
        self._period_ns, self._longest_ns = period_ns, longest_ns
        self._newest_ns: int | None = None
        self._behind_ns, self._behind = 0, 0
        self._tick_ns: int | None = None
        self._last_ns = 0
        self.fresh, self.leapt, self.stamp_step_ns, self.clock_step_ns = True, False, 0, 0

    def step(self, stamp_ns: int, now_ns: int = 0) -> int:
        """Time since the last call, ns; 0 at the first one.

        Args:
            stamp_ns: of the sample.
            now_ns: instant at which it is handled, on a clock that nobody sets; 0 for none.
        """
        step_ns = self.stamp_step_ns = self._by_stamp(stamp_ns)
        return self._by_clock(now_ns, step_ns) if now_ns else step_ns

    def _by_stamp(self, stamp_ns: int) -> int:
        newest, self.fresh, self.leapt = self._newest_ns, True, False
        if newest is None:
            self._newest_ns = stamp_ns
            return 0
        if stamp_ns > newest:
            self._newest_ns, self._behind = stamp_ns, 0
            step_ns = stamp_ns - newest
            self.leapt = step_ns > self._longest_ns
            return self._period_ns if self.leapt else step_ns
        goes_on = self._behind and stamp_ns > self._behind_ns
        self._behind = self._behind + 1 if goes_on else 1
        self._behind_ns = stamp_ns
        if self._behind < RESYNC_AFTER:
            self.fresh = False
            return 0
        self._newest_ns, self._behind = stamp_ns, 0
        return self._period_ns

    def _by_clock(self, now_ns: int, step_ns: int) -> int:
        if self._tick_ns is None:
            self._tick_ns = self._last_ns = now_ns
            return 0
        self.clock_step_ns, self._last_ns = max(now_ns - self._last_ns, 0), now_ns
        period, since_ns = self._period_ns, max(now_ns - self._tick_ns, 0)
        if self.fresh and not self.leapt and since_ns - step_ns > AWAY * period:
            self._tick_ns = now_ns
            return step_ns
        ticks = round(since_ns / period)
        off_ns = since_ns - ticks * period
        if abs(off_ns) > CLEAR * period:
            stamped = round(step_ns / period)
            if abs(stamped * period - since_ns) < period:
                ticks, off_ns = stamped, since_ns - stamped * period
        if ticks:
            self._tick_ns += ticks * period + off_ns // FOLLOW
        return ticks * period
