"""A host's end of a bus in the boards' own process, and one whose controller refuses to send."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from typing import Protocol

import can

from sim.damiao.faults import Faults


def refuse() -> can.CanOperationError:
    """What socketcan raises where the controller's queue is full."""
    return can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)


class Served(Protocol):
    """Boards that work when they are called."""

    def service(self) -> int:
        """Handle the frames that have arrived."""


class ServedBus(can.BusABC):
    """A host's bus whose boards live in the same process: whoever receives lets them work.

    Attributes:
        serving: whether to do so; without it the boards' owner calls `Boards.service`.
    """

    def __init__(self, bus: can.BusABC, boards: Served) -> None:
        """Wrap the host's end of a bus; closing closes it."""
        self._bus, self._boards, self.serving = bus, boards, True
        self._can_protocol = bus.protocol
        self.channel_info = bus.channel_info
        super().__init__(channel=0)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send."""
        self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Let the boards work, then receive."""
        if self.serving:
            self._boards.service()
        return self._bus.recv(timeout)

    def shutdown(self) -> None:
        """Close the bus inside as well."""
        super().shutdown()
        self._bus.shutdown()


class FailingBus(can.BusABC):
    """Any bus, with fault `enobufs` on its sends; everything else goes straight through."""

    def __init__(
        self, bus: can.BusABC, faults: Faults, now_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """Wrap a bus; closing closes it. The faults' time runs from here."""
        self._bus, self._faults, self._now_ns = bus, faults, now_ns
        self._begun_ns = now_ns()
        self._can_protocol = bus.protocol
        self.channel_info = bus.channel_info
        super().__init__(channel=0)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send, or raise CanOperationError (ENOBUFS)."""
        if self._faults.strikes("enobufs", (self._now_ns() - self._begun_ns) * 1e-9):
            raise refuse()
        self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Receive."""
        return self._bus.recv(timeout)

    def fileno(self) -> int:
        """Of the bus inside."""
        return self._bus.fileno()

    def shutdown(self) -> None:
        """Close the bus inside as well."""
        super().shutdown()
        self._bus.shutdown()
