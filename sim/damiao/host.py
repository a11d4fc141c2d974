"""The host's side of a bus whose boards live in the same process: bus ends and whole drivers."""

from __future__ import annotations

from collections.abc import Callable

import can

from drivers.interface import Driver, JointSample, PassedOn
from sim.damiao.server import Boards
from sim.scenarios import Scenario


class ServedBus(can.BusABC):
    """A host's bus whose boards live in the same process: whoever receives lets them work.

    Everything else goes straight through; closing closes the bus inside as well.

    Attributes:
        serving: whether to do so; without it the boards' owner calls `Boards.service`.
    """

    def __init__(self, bus: can.BusABC, boards: Boards) -> None:
        """Wrap the host's end of a bus."""
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

    def fileno(self) -> int:
        """Of the bus inside."""
        return self._bus.fileno()

    def shutdown(self) -> None:
        """Close."""
        super().shutdown()
        self._bus.shutdown()


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
        near = can.Bus(interface="virtual", channel=channel)
        self._bus = ServedBus(near, self._boards)
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
