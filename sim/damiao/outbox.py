"""Replies on their way to the bus, and what faults make of them there."""

from __future__ import annotations

import contextlib
import heapq

import can

from sim.damiao.faults import LATE_NS, SPIKE_RAD, Faults
from sim.damiao.frames import BUS_ERROR, error_frame


class Outbox:
    """Sends replies, now or later.

    Attributes:
        sent: frames that went out, error frames not counted.
        failed: frames that the bus would not take.
    """

    def __init__(self, bus: can.BusABC, faults: Faults) -> None:
        self._bus, self._faults = bus, faults
        self._later: list[tuple[int, int, can.Message]] = []
        self._behind: list[can.Message] = []
        self._count = 0
        self.sent = self.failed = 0

    def put(self, message: can.Message, now_ns: int, now_s: float) -> None:
        """Send a reply, as far as the faults allow."""
        if not self._faults:
            self._send(message)
            return
        strikes = self._faults.strikes
        if strikes("error_frames", now_s):
            self.tell(error_frame(BUS_ERROR))
        if strikes("drop", now_s):
            return
        if strikes("corrupt", now_s):
            self._corrupt(message)
        if strikes("late", now_s):
            self._count += 1
            heapq.heappush(self._later, (now_ns + LATE_NS, self._count, message))
        elif strikes("reorder", now_s):
            self._behind.append(message)
        else:
            self._send(message)
            if strikes("repeat", now_s):
                self._send(message)
            waiting, self._behind = self._behind, []
            for held in waiting:
                self._send(held)

    def tell(self, message: can.Message) -> None:
        """Put something on the bus that is no reply."""
        with contextlib.suppress(can.CanError):
            self._bus.send(message)

    def flush(self, now_ns: int) -> None:
        """Send what is due by now."""
        while self._later and self._later[0][0] <= now_ns:
            self._send(heapq.heappop(self._later)[2])

    def next_ns(self) -> int | None:
        """When the next late reply is due."""
        return self._later[0][0] if self._later else None

    def _send(self, message: can.Message) -> None:
        try:
            self._bus.send(message)
            self.sent += 1
        except can.CanError:
            self.failed += 1

    def _corrupt(self, message: can.Message) -> None:
        size, pick = len(message.data), self._faults.pick
        if pick(2):
            message.data[pick(size)] ^= 1 << pick(8)
        else:
            del message.data[pick(size) :]
            message.dlc = len(message.data)


def spiked(q: float, faults: Faults, now_s: float) -> float:
    """An angle, or one that is far off."""
    if faults.strikes("spike", now_s):
        return q + (SPIKE_RAD if faults.pick(2) else -SPIKE_RAD)
    return q
