"""A driver and joint boards in lockstep on a line: real frames, exact times, as fast as it goes."""

from __future__ import annotations

from drivers.interface import Array, Driver, Intake, JointSample
from sim.damiao.line import Line

SETTLE_TICKS = 300  # the motors take the arm over from its stand


class Lockstep:
    """A driver whose clock is the line's: each `read` lets one period of virtual time pass.

    Args:
        driver: built on `line.host` with the clock `line.now_ns`.
        line: with the boards attached.
    """

    paced = False
    arrived_ns = 0

    def __init__(self, driver: Driver, line: Line) -> None:
        self._driver, self._line = driver, line
        self.joint_names, self.link_names = driver.joint_names, driver.link_names
        self.period_ns = driver.period_ns
        self.can_move, self.adds_gravity = driver.can_move, driver.adds_gravity
        self.delay_ns = driver.delay_ns
        self._next_ns = 0

    @property
    def intake(self) -> Intake:
        """The driver's."""
        return self._driver.intake

    def connect(self) -> None:
        """Connect and let the arm come to rest in its motors. Raises DriverError."""
        with self._line.eager():
            self._driver.connect()
        self._next_ns = self._line.next_whole_ns(self.period_ns)
        for _ in range(SETTLE_TICKS):
            self.read()

    def read(self) -> JointSample:
        """The next sample. Raises DriverError."""
        self._line.advance_to(self._next_ns)
        self._next_ns += self.period_ns
        return self._driver.read()

    def command(self, tau: Array) -> None:
        """Pass on (n,) N m. Raises DriverError."""
        self._driver.command(tau)

    def stop(self) -> None:
        """Bring the arm to a stand. Raises DriverError."""
        with self._line.eager():
            self._driver.stop()

    def close(self) -> None:
        """Release the driver."""
        with self._line.eager():
            self._driver.close()
