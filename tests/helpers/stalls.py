"""How long this machine stood still, seen by a thread that wants to run every millisecond."""

from __future__ import annotations

import threading
import time

PERIOD_S = 1e-3


class Stalls:
    """Watches while it is entered.

    Attributes:
        worst_s: the longest time for which the thread did not get to run when it should have.
    """

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> Stalls:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        before = time.monotonic()
        while not self._over.is_set():
            time.sleep(PERIOD_S)
            now = time.monotonic()
            self.worst_s = max(self.worst_s, now - before - PERIOD_S)
            before = now
