"""When a served arm ends: at SIGTERM or SIGINT, or when its time is over."""

from __future__ import annotations

import signal
import threading
import time


class Ending:
    """To be entered in the main thread; the signals have their usual effect again behind it.

    Args:
        duration_s: None for no end but a signal.
    """

    def __init__(self, duration_s: float | None) -> None:
        self._event = threading.Event()
        self._end = None if duration_s is None else time.monotonic() + duration_s

    def __enter__(self) -> Ending:
        numbers = (signal.SIGTERM, signal.SIGINT)
        self._before = {number: signal.signal(number, self._hear) for number in numbers}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _hear(self, number: int, frame: object) -> None:
        self._event.set()

    def is_set(self) -> bool:
        """Whether to end."""
        return self._event.is_set() or (self._end is not None and time.monotonic() >= self._end)
