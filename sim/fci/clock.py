"""The simulated milliseconds: absolute deadlines, and a world that slips where time was taken."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from drivers.process import pin, quiet_collector, request_fifo, sleep_until

PERIOD_NS = 1_000_000
PRIORITY = 80  # of SCHED_FIFO: above any client loop but those that take 99


class Ticks:
    """Waits for one tick after the other; lost time is counted, not caught up with.

    From one tick's end to the next a client has half a millisecond, as at a real robot: where the
    simulation of a tick took longer than the other half, the world slips by so much.
    """

    def __init__(
        self, now: Callable[[], int] = time.monotonic_ns, sleep: Callable[[int], None] = sleep_until
    ) -> None:
        self._now, self._sleep = now, sleep
        self._due = self._slipped = 0

    @property
    def stalled(self) -> int:
        """Milliseconds by which the simulated world is behind the clock on the wall."""
        return self._slipped // PERIOD_NS

    def restart(self) -> None:
        """The next tick is one period from now."""
        self._due = self._now()

    def wait(self) -> None:
        """Return at the next tick, to be called at the end of the one before."""
        now = self._now()
        late = max(now + 500_000 - self._due - PERIOD_NS, 0)  # ns (Franka FCI documentation)
        self._slipped += late
        self._due += PERIOD_NS + late
        wake = self._due - 60_000  # a wake-up costs the system that much
        while now < wake:
            self._sleep(wake)
            now = self._now()
        while now < self._due:
            now = self._now()


@contextmanager
def undisturbed(core: int | None = None) -> Iterator[None]:
    """Priority, a core and no collector for the calling thread, as far as the system permits."""
    asked = [request_fifo(PRIORITY), quiet_collector()]
    with ExitStack() as undo:
        for _, back in asked if core is None else [pin({core}), *asked]:
            if back is not None:
                undo.callback(back)
        yield
