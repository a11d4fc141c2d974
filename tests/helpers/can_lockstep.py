"""A driver on a simulated CAN line, in lockstep with the line's clock."""

from __future__ import annotations

from drivers.damiao.arm import DamiaoArm
from drivers.interface import Driver, JointSample, PassedOn
from sim.damiao.line import Line
from sim.damiao.server import Boards
from sim.scenarios import Scenario

SETTLE_TICKS = 300  # the motors take the arm over from its stand


class Lockstep(PassedOn):
    """A driver whose clock is the line's: each `read` lets one period of virtual time pass.

    Args:
        driver: built on `line.host` with the clock `line.now_ns`.
        line: with the boards attached.
    """

    paced = False
    arrived_ns = 0

    def __init__(self, driver: Driver, line: Line) -> None:
        super().__init__(driver)
        self._line, self._next_ns = line, 0

    def connect(self) -> None:
        """Connect and let the arm come to rest in its motors. Raises DriverError."""
        with self._line.eager():
            self.driver.connect()
        self._next_ns = self._line.next_whole_ns(self.period_ns)
        for _ in range(SETTLE_TICKS):
            self.read()

    def read(self) -> JointSample:
        """The next sample. Raises DriverError."""
        self._line.advance_to(self._next_ns)
        self._next_ns += self.period_ns
        return self.driver.read()

    def stop(self) -> None:
        """Bring the arm to a stand. Raises DriverError."""
        with self._line.eager():
            self.driver.stop()
        self._next_ns = self._line.next_whole_ns(self.period_ns)  # it took a while

    def close(self) -> None:
        """Release the driver."""
        with self._line.eager():
            self.driver.close()

    def sleep(self, seconds: float) -> None:
        """Let the line's time pass, in place of this machine's."""
        self._line.advance_to(self._line.now_ns() + int(1e9 * seconds))


def on_line(world: Scenario) -> tuple[Lockstep, Boards]:
    """An arm that may move behind Damiao motors on a line of its own, and the motors' boards."""
    line = Line()
    boards = Boards(line.boards, world, now_ns=line.now_ns)
    line.attach(boards)
    clocks = {"now_ns": line.now_ns, "wall_ns": line.now_ns}
    address, names = "can://line?interface=virtual", world.truth.joint_names
    return Lockstep(DamiaoArm(address, names, True, bus=line.host, **clocks), line), boards
