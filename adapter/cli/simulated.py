"""Simulated arms for `run`. Nothing of what is true of them reaches the learner."""

from __future__ import annotations

import dataclasses
from functools import partial

from drivers.damiao.arm import DamiaoArm
from drivers.damiao.settings import BusSettings
from drivers.interface import Driver
from sim.damiao.host import InProcess
from sim.options import DEFAULT_SCENARIO, options_of
from sim.plant import SimulatedArm
from sim.scenarios import Scenario, build


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A simulated arm that was asked for.

    Attributes:
        address: of the driver.
        scenario: what is hidden in it.
        asked_for: the scenario was named on the command line.
    """

    address: str
    scenario: Scenario
    asked_for: bool

    def driver(self, rest: str) -> Driver:
        """The driver, with its plant; behind frames on a virtual bus where the address says so."""
        if not self.address.startswith("can:"):
            return SimulatedArm(self.scenario.plant())
        names = self.scenario.truth.joint_names
        arm = partial(DamiaoArm, self.address, names, allow_motion=True)
        channel = BusSettings.of(self.address, names).channel
        return InProcess(channel, self.scenario, lambda bus: arm(bus=bus))


def simulation(address: str, scenario: str | None, options: list[str], seed: int) -> Simulation:
    """The simulated arm of an address (see `arguments.simulated`).

    Raises:
        ValueError: no such scenario or option (names the choices).
    """
    chosen = options_of(options)
    if chosen.get("imus") and not address.startswith("pybullet"):
        raise ValueError("imus: no sensor on a link is heard over a CAN bus; have: pybullet:panda")
    world = build(scenario or DEFAULT_SCENARIO, seed, **chosen)
    return Simulation(address, world, scenario is not None)
