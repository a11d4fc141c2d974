"""The same simulated arm behind each driver, one tick at a time and without a clock."""

from __future__ import annotations

from drivers.damiao import holding
from drivers.damiao.arm import DamiaoArm
from drivers.interface import Driver
from drivers.pybullet_arm import PyBulletArm
from sim.damiao.host import Lockstep
from sim.damiao.line import Line
from sim.damiao.server import Boards
from sim.obstacles import Obstacles
from sim.scenarios import Scenario
from tests.helpers.fci_lockstep import FciLockstep

# When a motion can begin, by the plant's time: motors of a CAN arm are switched on and settle
# first, 1.35 to 1.5 s here.
BEGINS_S = {"sim": 0.0, "fci": 0.0, "can": 1.6}


def opened(name: str, world: Scenario) -> tuple[Driver, Obstacles]:
    """The driver, and what is in the way of its arm."""
    if name == "sim":
        plant = world.plant()
        return PyBulletArm(plant), plant._engine.obstacles
    if name == "fci":
        robot = FciLockstep(world)
        return robot, robot.served.arm._plant._engine.obstacles

    class Clock:  # whoever waits lets the line's time pass
        @staticmethod
        def sleep(seconds: float) -> None:
            line.advance_to(line.now_ns() + int(1e9 * seconds))

    line = Line()
    boards = Boards(line.boards, world, now_ns=line.now_ns)
    line.attach(boards)
    vars(holding)["time"] = Clock
    clocks = {"now_ns": line.now_ns, "wall_ns": line.now_ns}
    address, names = "can://line?interface=virtual", world.truth.joint_names
    arm = Lockstep(DamiaoArm(address, names, True, bus=line.host, **clocks), line)
    return arm, boards.world._engine.obstacles
