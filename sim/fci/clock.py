"""The simulated milliseconds: absolute deadlines, and a world that slips where time was taken."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from drivers.process import sleep_until

PERIOD_NS = 1_000_000
ANSWER_NS = 500_000  # a client's own part of a period (Franka FCI documentation)
SPIN_NS = 60_000  # waiting actively for the last part: a wake-up costs the system that much
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
        late = max(now + ANSWER_NS - self._due - PERIOD_NS, 0)
        self._slipped += late
        self._due += PERIOD_NS + late
        wake = self._due - SPIN_NS
        while now < wake:
            self._sleep(wake)
            now = self._now()
        while now < self._due:
            now = self._now()


@contextmanager
def undisturbed(core: int | None = None) -> Iterator[None]:
    """Priority, a core and no collector for the calling thread, as far as the system permits."""
    with ExitStack() as undo:
        if core is not None:
            before = os.sched_getaffinity(0)
            with suppress(OSError, ValueError):
                os.sched_setaffinity(0, {core})
                undo.callback(os.sched_setaffinity, 0, before)
        policy = os.sched_getscheduler(0), os.sched_getparam(0)
        with suppress(OSError, ValueError):
            fifo = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, fifo, os.sched_param(PRIORITY))
            undo.callback(os.sched_setscheduler, 0, *policy)
        if gc.isenabled():
            gc.collect()
            gc.freeze()
            gc.disable()
            undo.callback(gc.enable)
            undo.callback(gc.unfreeze)
        yield
