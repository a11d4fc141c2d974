"""How soon a thread gets the interpreter back from a busy one."""

from __future__ import annotations

import sys
import threading

# A reader that wakes up asks for the interpreter lock and waits this long before the running
# thread is told to give it up. Python's default of 5 ms is five ticks of the robot.
SWITCH_INTERVAL_S = 50e-6


class QuickSwitching:
    """Shortens the interpreter's switch interval while anybody needs it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users, self._before_s = 0, 0.0

    def begin(self) -> None:
        """One more user."""
        with self._lock:
            if self._users == 0:
                self._before_s = sys.getswitchinterval()
                sys.setswitchinterval(min(self._before_s, SWITCH_INTERVAL_S))
            self._users += 1

    def end(self) -> None:
        """One user less; the last one gives the old interval back."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                sys.setswitchinterval(self._before_s)


QUICK_SWITCHING = QuickSwitching()
