"""What a loop asks of the operating system: priority, locked memory, its own core, no collector.

Nothing is demanded: each request says in one line whether it was granted, and why not. And its
deadlines, t0 + k * period: no drift, and a missed one is missed, not postponed.
"""

from __future__ import annotations

import ctypes
import os
import resource
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack

from drivers.process import Answer, pin, quiet_collector, request_fifo, sleep_until


def split_cores(allowed: Sequence[int] | None = None) -> tuple[set[int], set[int]]:
    """Cores of the loop (the last one allowed) and of the workers (the others, if any)."""
    cores = sorted(os.sched_getaffinity(0) if allowed is None else allowed)
    return {cores[-1]}, set(cores[:-1]) or {cores[-1]}


class RealTime:
    """Asks on entry, gives everything back on exit. For the thread that runs the loop.

    Args:
        core: the loop's.

    Attributes:
        grants: the answers' sentences, in order.
    """

    def __init__(self, core: int) -> None:
        self._core, self._undo = core, ExitStack()
        self.grants: list[str] = []

    def __enter__(self) -> RealTime:
        fifo = request_fifo(70)  # above the kernel's interrupt threads (50), below watchdogs (99)
        for answer in (quiet_collector(), lock_memory(), pin({self._core}), fifo):
            line, undo = answer
            self.grants.append(line)
            if undo is not None:
                self._undo.callback(undo)
        return self

    def __exit__(self, *error: object) -> None:
        self._undo.close()


def lock_memory() -> Answer:
    """mlockall: present pages, and future ones where no limit could make an allocation fail."""
    libc = ctypes.CDLL(None, use_errno=True)
    unlimited = os.geteuid() == 0 or (
        resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    )
    flags = 3 if unlimited else 1  # MCL_CURRENT and MCL_FUTURE of <sys/mman.h>
    if libc.mlockall(flags) != 0:
        reason = os.strerror(ctypes.get_errno())
        why = "needs root, CAP_IPC_LOCK or a memlock limit (ulimit -l)"
        return f"memory: lock refused ({reason}); {why}", None
    what = "present and future pages" if unlimited else "present pages only (ulimit -l)"

    def undo() -> None:
        libc.munlockall()

    return f"memory: locked, {what}", undo


SPIN_NS = 120_000  # wait actively for so long: waking up takes the system some 50 to 100 µs


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
