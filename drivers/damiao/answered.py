"""What became of the commands to motors that we set the rhythm of: sent, answered, holes.

A motor replies to each command. A command that reached all motors in time is one that all of them
replied to before the next one went out; the share is taken over joints, so that one silent motor
of seven leaves 6/7. Replies carry no number: where one comes a period late and each after it, too,
only the first counts as missing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from drivers.damiao.timing import Reading
from drivers.interface import CommandCount

WINDOW = 100  # commands that the worst share is taken over, as a Franka's is


class AnsweredCommands:
    """Counts commands and their replies.

    Args:
        count: where to.
        period_ns: from one command to the next.
    """

    def __init__(self, count: CommandCount, period_ns: int) -> None:
        self._count, self._period_ns = count, period_ns
        self._replied, self._asked, self._full = 0, 0, False
        self.pause()

    def pause(self) -> None:
        """The arm is held, by commands that are not the loop's; the next one begins anew."""
        self._last_ns = self._asked_ns = 0
        self._window: deque[int] = deque(maxlen=WINDOW)
        self._window_sum = 0

    def look(self, latest: Sequence[Reading]) -> None:
        """See who replied to the last command; called before the next one goes out.

        Args:
            latest: last reading of each joint.
        """
        asked_ns, self._asked_ns = self._asked_ns, 0
        if not asked_ns:
            return
        replied = 0
        for reading in latest:
            replied += reading[0] >= asked_ns
        self._replied += replied
        self._asked += len(latest)
        window = self._window
        if len(window) == WINDOW:
            self._window_sum -= window[0]
        window.append(replied)
        self._window_sum += replied
        self._count.success_mean = self._replied / self._asked
        if len(window) == WINDOW:
            rate = self._window_sum / (WINDOW * len(latest))
            least = self._count.success_min if self._full else None
            self._count.success_min = rate if least is None else min(least, rate)
            self._full = True
        elif not self._full:
            self._count.success_min = self._count.success_mean

    def sent(self, asked_ns: int, whole: bool, cut: bool) -> None:
        """A command went out.

        Args:
            asked_ns: when, CLOCK_MONOTONIC.
            whole: to every motor; a command that the bus did not take is none.
            cut: a motor's TMAX changed it.
        """
        count = self._count
        count.cut += cut
        if not whole:
            return
        step_ns = asked_ns - self._last_ns
        if self._last_ns and step_ns >= 1.5 * self._period_ns:  # nearer to the next one's turn
            count.holes += 1
            count.longest_hole_ms = max(count.longest_hole_ms, 1e-6 * step_ns)
        self._last_ns = self._asked_ns = asked_ns
        count.sent += 1
