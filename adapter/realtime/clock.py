"""Absolute deadlines t0 + k * period: no drift, and a missed one is missed, not postponed."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable

SPIN_NS = 120_000  # wait actively for so long: waking up takes the system some 50 to 100 µs
TIMER_ABSTIME = 1  # <time.h>
_libc = ctypes.CDLL(None, use_errno=True)


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


def sleep_until(deadline_ns: int) -> None:
    """Sleep until CLOCK_MONOTONIC shows `deadline_ns`, or until a signal."""
    at = _Timespec(*divmod(deadline_ns, 1_000_000_000))
    code = _libc.clock_nanosleep(time.CLOCK_MONOTONIC, TIMER_ABSTIME, ctypes.byref(at), None)
    if code not in (0, errno.EINTR):
        raise OSError(code, os.strerror(code))


class Clock:
    """Deadlines of a periodic loop.

    Args:
        period_ns: between deadlines.
        spin_ns: how long before a deadline sleeping ends and spinning begins.
        now: CLOCK_MONOTONIC, ns.
        sleep: returns at a time of that clock, or earlier.
        used: processor time that this thread has used, ns.

    Attributes:
        k: number of the deadline that `wait` returned at last; -1 before the first.
        missed: deadlines that went by unused.
        missed_own: of these, such as the loop's own work filled, by the processor time that it
            used; at the others the machine had given the processor to somebody else.
    """

    def __init__(
        self,
        period_ns: int,
        spin_ns: int = SPIN_NS,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_until,
        used: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self.period_ns, self.k, self.missed, self.missed_own = period_ns, -1, 0, 0
        self._spin_ns, self._now, self._sleep, self._used = spin_ns, now, sleep, used
        self._used_ns = 0
        self._t0: int | None = None

    def start(self) -> None:
        """Deadline 0 is one period from now."""
        self._t0 = self._now() + self.period_ns
        self.k, self.missed, self.missed_own = -1, 0, 0
        self._used_ns = self._used()

    def follow(self, now_ns: int) -> None:
        """Where the source keeps the rhythm: a tick begins; periods without one count as missed."""
        if self._t0 is not None:
            skipped = round((now_ns - self._t0) / self.period_ns) - 1
            if skipped > 0:
                self.missed += skipped
                self.missed_own += self._own(skipped)
        self._t0, self._used_ns = now_ns, self._used()

    def _own(self, skipped: int) -> int:
        """Of the deadlines that went by, such as the loop's own work filled, or ran into."""
        periods = (self._used() - self._used_ns) / self.period_ns
        return min(skipped, int(periods) + 1) if periods > 1.0 else 0

    def wait(self) -> int:
        """Wait for the next deadline; returns by how much it is late, ns.

        Late by up to a period, the loop goes on at once. Later than that, the deadlines that
        are gone count as missed and the next one in the future is waited for.
        """
        if self._t0 is None:
            self.start()
        assert self._t0 is not None
        k = self.k + 1
        behind = self._now() - (self._t0 + k * self.period_ns)
        if behind > self.period_ns:
            skipped = behind // self.period_ns + 1
            self.missed += skipped
            self.missed_own += self._own(skipped)
            k += skipped
        self.k = k
        deadline = self._t0 + k * self.period_ns
        wake = deadline - self._spin_ns
        while self._now() < wake:
            self._sleep(wake)
        now = self._now()
        while now < deadline:
            now = self._now()
        self._used_ns = self._used()
        return now - deadline
