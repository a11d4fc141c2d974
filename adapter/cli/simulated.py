"""Simulated arms for `run`: the only place where adapter and sim meet."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from adapter.cli.common import UsageError
from adapter.model import SelfModel
from drivers.address import Address
from drivers.interface import Driver
from drivers.pybullet_arm import PyBulletArm
from drivers.registry import split_address

if TYPE_CHECKING:
    from sim.scenarios import Scenario

ARMS = ("panda",)
DEFAULT_SCENARIO = "nominal"


@dataclasses.dataclass(frozen=True)
class Simulation:
    """A simulated arm that was asked for.

    Attributes:
        address: of the driver.
        scenario: what is hidden in it.
        asked_for: the scenario was named on the command line.
        seed: of what its sensors add.
    """

    address: str
    scenario: Scenario
    asked_for: bool
    seed: int

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects worth learning: those of a real arm where the simulated one has friction."""
        truth = self.scenario.truth
        found = []
        if np.any(truth.Fv):
            found.append("viscous_friction")
        if np.any(truth.Fc):
            found.append("coulomb_friction")
        if np.any(truth.torque_offset):
            found.append("torque_offset")
        if np.any(truth.motor_inertia):
            found.append("motor_inertia")
        return tuple(found)

    def mounted(self, robot: SelfModel) -> SelfModel:
        """The documented robot mounted as the simulated one is: that much is known of it."""
        return dataclasses.replace(robot, gravity=np.array(self.scenario.truth.gravity))

    def driver(self, rest: str) -> Driver:
        """The driver, with its plant; behind frames on a virtual bus where the address says so."""
        if not self.address.startswith("can:"):
            return PyBulletArm(self.scenario.plant())
        from drivers.damiao.arm import DamiaoArm
        from drivers.damiao.settings import BusSettings
        from sim.damiao.in_process import InProcess

        names = self.scenario.truth.joint_names
        channel = BusSettings.of(self.address, names).channel
        return InProcess(
            channel,
            self.scenario,
            self.seed,
            lambda bus: DamiaoArm(self.address, names, allow_motion=True, bus=bus),
        )


def simulation(
    address: str, scenario: str | None, options: list[str], seed: int
) -> Simulation | None:
    """The simulated arm of an address; None where the address names no simulation of ours.

    A virtual CAN bus lives in one process only: its motors are simulated here.

    Raises:
        UsageError: no such arm, a scenario for a real arm, an option that is no KEY=VALUE.
        ValueError: no such scenario or option (names the choices).
    """
    scheme, arm = split_address(address)
    if scheme != "pybullet" and not _on_virtual_bus(address):
        if scenario or options:
            raise UsageError(
                f"--scenario and --set need --driver pybullet:..., not {address}; for a served "
                "arm give them to `adapter sim`"
            )
        return None
    if scheme == "pybullet" and arm not in ARMS:
        raise UsageError(f"no simulated arm '{arm}'; have: {', '.join(ARMS)}")
    from sim.scenarios import (  # brings PyBullet, which the workers have no use for
        build,
        options_of,
    )

    chosen = options_of(options)
    world = build(scenario or DEFAULT_SCENARIO, seed, **chosen)
    return Simulation(address, world, scenario is not None, seed)


def _on_virtual_bus(address: str) -> bool:
    if not address.startswith("can:"):
        return False
    from drivers.damiao.settings import OPTIONS

    return Address.of(address, OPTIONS).options.get("interface") == "virtual"
