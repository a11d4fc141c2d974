"""The host's side of a bus whose boards live in the same process: bus ends and whole drivers."""

from __future__ import annotations

from collections.abc import Callable

import can
from can.interfaces.virtual import VirtualBus

from drivers.interface import Driver, JointSample, PassedOn
from sim.damiao.server import Boards
from sim.scenarios import Scenario


class ServedBus(VirtualBus):
    """A host's end of a virtual bus whose boards live in the same process.

    Attributes:
        serving: whoever receives lets the boards work; without it their owner calls
            `Boards.service`.
    """

    def __init__(self, channel: str, boards: Boards) -> None:
        """Join the boards' channel."""
        super().__init__(channel)
        self._boards, self.serving = boards, True

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Let the boards work, then receive."""
        if self.serving:
            self._boards.service()
        return super().recv(timeout)


class InProcess(PassedOn):
    """A driver whose motors work between its reads, in real time.

    Args:
        channel: of the virtual bus.
        scenario: the arm.
        make: builds the driver on a bus.

    Attributes:
        plant_time_ns: how long the boards worked in the last `read`; no part of a driver's time.
    """

    paced = False

    def __init__(
        self, channel: str, scenario: Scenario, make: Callable[[can.BusABC], Driver]
    ) -> None:
        self._far = can.Bus(interface="virtual", channel=channel)
        self._boards = Boards(self._far, scenario)
        self._bus = ServedBus(channel, self._boards)
        super().__init__(make(self._bus))
        self.plant_time_ns = 0
        self._closed = False

    def connect(self) -> None:
        """Connect; the boards answer. Raises DriverError."""
        self.driver.connect()
        self._bus.serving = False

    def read(self) -> JointSample:
        """Let the motors work up to now, then read. Raises DriverError."""
        before = self._boards.compute_ns
        self._boards.service()
        self.plant_time_ns = self._boards.compute_ns - before
        return self.driver.read()

    def stop(self) -> None:
        """Bring the arm to a stand. Raises DriverError."""
        self._bus.serving = True
        self.driver.stop()

    def close(self) -> None:
        """Release driver, boards and bus; may be called more than once."""
        if self._closed:
            return
        self._closed, self._bus.serving = True, True
        self.driver.close()
        self._boards.close()
        self._bus.shutdown()
        self._far.shutdown()
