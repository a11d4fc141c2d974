"""How long this machine stood still, seen on each of its cores by a thread of its own."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress

PERIOD_S = 1e-3
LATE_S = 2e-3  # a thread that wakes up within that was not held up


class Stalls:
    """Watches while it is entered.

    Args:
        nice: how much the watching threads yield: what a process as nice as that suffers.

    Attributes:
        worst_s: the longest time for which a thread did not get to run when it should have.
        total_s: all such times together, on the core that had most of them.
    """

    def __init__(self, nice: int = 0) -> None:
        self.worst_s = self.total_s = 0.0
        self._nice, self._over = nice, threading.Event()
        cores = os.sched_getaffinity(0)
        self._threads = [threading.Thread(target=self._watch, args=(core,)) for core in cores]

    def __enter__(self) -> Stalls:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _watch(self, core: int) -> None:
        with suppress(OSError):  # Linux knows threads by number; both calls are for this one
            os.sched_setaffinity(0, {core})
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._nice)
        total_s, before = 0.0, time.monotonic()
        while not self._over.is_set():
            time.sleep(PERIOD_S)
            now = time.monotonic()
            late_s, before = now - before - PERIOD_S, now
            self.worst_s = max(self.worst_s, late_s)
            total_s += late_s if late_s > LATE_S else 0.0
            self.total_s = max(self.total_s, total_s)
