"""A driver with the joint boards in its own process, on python-can's virtual bus."""

from __future__ import annotations

from collections.abc import Callable

import can

from drivers.interface import Array, Driver, Intake, JointSample
from sim.damiao.boards import Boards
from sim.damiao.host_bus import ServedBus
from sim.scenarios import Scenario


class InProcess:
    """A driver whose motors work between its reads, in real time.

    Args:
        channel: of the virtual bus.
        scenario: the arm.
        seed: of noise and faults.
        make: builds the driver on a bus.

    Attributes:
        plant_time_ns: how long the boards worked in the last `read`; no part of a driver's time.
    """

    paced = False

    def __init__(
        self, channel: str, scenario: Scenario, seed: int, make: Callable[[can.BusABC], Driver]
    ) -> None:
        self._far = can.Bus(interface="virtual", channel=channel)
        self._boards = Boards(self._far, scenario, seed)
        near = can.Bus(interface="virtual", channel=channel)
        self._bus = ServedBus(near, self._boards)
        self._driver = driver = make(self._bus)
        self.joint_names, self.link_names = driver.joint_names, driver.link_names
        self.period_ns, self.adds_gravity = driver.period_ns, driver.adds_gravity
        self.can_move, self.delay_ns = driver.can_move, driver.delay_ns
        self.plant_time_ns = 0
        self._closed = False

    @property
    def intake(self) -> Intake:
        """The driver's."""
        return self._driver.intake

    @property
    def arrived_ns(self) -> int:
        """The driver's."""
        return self._driver.arrived_ns

    def connect(self) -> None:
        """Connect; the boards answer. Raises DriverError."""
        self._driver.connect()
        self._bus.serving = False

    def read(self) -> JointSample:
        """Let the motors work up to now, then read. Raises DriverError."""
        before = self._boards.compute_ns
        self._boards.service()
        self.plant_time_ns = self._boards.compute_ns - before
        return self._driver.read()

    def command(self, tau: Array) -> None:
        """Pass on (n,) N m. Raises DriverError."""
        self._driver.command(tau)

    def stop(self) -> None:
        """Bring the arm to a stand. Raises DriverError."""
        self._bus.serving = True
        self._driver.stop()

    def close(self) -> None:
        """Release driver, boards and bus; may be called more than once."""
        if self._closed:
            return
        self._closed, self._bus.serving = True, True
        self._driver.close()
        self._boards.close()
        self._bus.shutdown()
        self._far.shutdown()
