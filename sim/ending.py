"""How a served arm ends: at SIGTERM or SIGINT, or when its time is over, with a summary."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any


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


def sum_up(summary: Mapping[str, Any], lines: str | None, path: Path | None) -> None:
    """Say what happened, in these lines or one for each number, and write it where wanted."""
    print(lines or "\n".join(f"{key}: {value}" for key, value in summary.items()), flush=True)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(summary, indent=1) + "\n", "utf-8")
