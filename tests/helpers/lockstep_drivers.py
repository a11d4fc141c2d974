"""The same simulated arm behind each driver, one tick at a time and without a clock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

from drivers.damiao import holding
from drivers.fci import torque_control
from drivers.interface import Driver
from drivers.pybullet_arm import PyBulletArm
from sim.joint_effects import Obstacles
from sim.scenarios import Scenario
from tests.helpers.can_lockstep import on_line
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
            driver, boards = on_line(world)
            after.callback(boards.close)
            obstacles = boards.world._engine.obstacles
            after.enter_context(in_place_of_time(holding, driver))
        after.callback(driver.close)
        yield driver, obstacles


@contextmanager
def in_place_of_time(module: ModuleType, clock: Any) -> Iterator[None]:
    """Let one module have this clock where it asks `time`; its own again afterwards."""
    own = vars(module)["time"]
    vars(module)["time"] = clock
    try:
        yield
    finally:
        vars(module)["time"] = own
