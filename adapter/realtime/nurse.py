"""Starts processes beside the loop: to start one takes milliseconds that a tick does not have."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue

from adapter.realtime.worker import Worker

JOIN_S = 30.0


class Birth:
    """A worker that is being started.

    Attributes:
        worker: once it is started; trouble: why it was not.
    """

    def __init__(self, build: Callable[[], Worker]) -> None:
        self._build = build
        self._done = threading.Event()
        self.worker: Worker | None = None
        self.trouble: str | None = None

    @property
    def over(self) -> bool:
        """Whether there is a worker or a trouble."""
        return self._done.is_set()

    def happen(self) -> None:
        """Start it; called by the nurse."""
        try:
            self.worker = self._build()
        except Exception as error:  # whatever it is, the loop has to hear of it
            self.trouble = f"{type(error).__name__}: {error}"
        self._done.set()

    def wait(self, timeout_s: float) -> bool:
        """Whether it is over within this time."""
        return self._done.wait(timeout_s)


class Nurse:
    """A thread that starts workers; it sleeps until it is asked.

    It stays off the loop's core and takes no priority. Created before the loop asks for its own,
    so that it inherits none of that.

    Args:
        cores: where it may run.
    """

    def __init__(self, cores: set[int]) -> None:
        self._cores = cores
        self._asked: SimpleQueue[Birth | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="nurse", daemon=True)
        self._thread.start()

    def ask(self, build: Callable[[], Worker]) -> Birth:
        """Have a worker started; returns at once."""
        birth = Birth(build)
        self._asked.put(birth)
        return birth

    def close(self) -> None:
        """Let the thread end; may be called more than once."""
        if self._thread.is_alive():
            self._asked.put(None)
            self._thread.join(JOIN_S)

    def _work(self) -> None:
        with suppress(OSError):
            os.sched_setaffinity(0, self._cores)
        while (birth := self._asked.get()) is not None:
            birth.happen()
