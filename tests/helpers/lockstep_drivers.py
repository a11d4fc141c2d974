"""The same simulated arm behind each driver, one tick at a time and without a clock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

from drivers.damiao import holding
from drivers.damiao.arm import DamiaoArm
from drivers.fci import torque_control
from drivers.interface import Driver
from drivers.pybullet_arm import PyBulletArm
from sim.damiao.line import Line
from sim.damiao.server import Boards
from sim.obstacles import Obstacles
from sim.scenarios import Scenario
from tests.helpers.can_lockstep import Lockstep
from tests.helpers.fci_lockstep import FciLockstep

# When a motion can begin, by the plant's time: motors of a CAN arm are switched on and settle
# first, 1.35 to 1.5 s here.
BEGINS_S = {"sim": 0.0, "fci": 0.0, "can": 1.6}
# The same with 4 to 8 kg at the hand: a CAN arm uses up all of the 5 s that it may settle in.
BEGINS_LOADED_S = {**BEGINS_S, "can": 6.4}
LET_GO = 150  # readings after a stop in which it comes to that; ms


@contextmanager
def opened(name: str, world: Scenario) -> Iterator[tuple[Driver, Obstacles]]:
    """The driver, not connected yet, and what is in the way of its arm; closed afterwards."""
    with ExitStack() as after:
        if name == "sim":
            plant = world.plant()
            driver: Driver = PyBulletArm(plant)
            obstacles = plant._engine.obstacles
        elif name == "fci":
            driver = robot = FciLockstep(world)
            obstacles = robot.served.arm._plant._engine.obstacles
            after.enter_context(in_place_of_time(torque_control, robot))
        else:
            line = Line()
            boards = Boards(line.boards, world, now_ns=line.now_ns)
            line.attach(boards)
            after.callback(boards.close)
            clocks = {"now_ns": line.now_ns, "wall_ns": line.now_ns}
            address, names = "can://line?interface=virtual", world.truth.joint_names
            driver = Lockstep(DamiaoArm(address, names, True, bus=line.host, **clocks), line)
            obstacles = boards.world._engine.obstacles
            after.enter_context(in_place_of_time(holding, LineTime(line)))
        after.callback(driver.close)
        yield driver, obstacles


class LineTime:
    """Whoever waits lets a line's time pass."""

    def __init__(self, line: Line) -> None:
        self._line = line

    def sleep(self, seconds: float) -> None:
        self._line.advance_to(self._line.now_ns() + int(1e9 * seconds))


@contextmanager
def in_place_of_time(module: ModuleType, clock: Any) -> Iterator[None]:
    """Let one module have this clock where it asks `time`; its own again afterwards."""
    own = vars(module)["time"]
    vars(module)["time"] = clock
    try:
        yield
    finally:
        vars(module)["time"] = own
