"""Notices that the operator is gone: the terminal closed, or the program that started this one."""

from __future__ import annotations

import os
import select

GONE = select.POLLHUP | select.POLLERR | select.POLLNVAL


class Deadman:
    """Looks at the terminal and the parent process, some 2 µs a look.

    Where standard input is no terminal (a service, a pipe), the parent process alone is watched.

    Args:
        terminal: file descriptor of the operator's terminal.
    """

    def __init__(self, terminal: int = 0) -> None:
        self._parent = os.getppid()
        self._poll: select.poll | None = None
        if os.isatty(terminal):
            self._poll = select.poll()
            self._poll.register(terminal, 0)  # a hang-up is told without being asked for

    def gone(self) -> bool:
        """Whether nobody is there to stop the arm any more."""
        if os.getppid() != self._parent:
            return True
        if self._poll is None:
            return False
        return any(event & GONE for _, event in self._poll.poll(0))
