"""What an address says: `ros2:///joint_states?command=/effort_controller/commands&...`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from urllib.parse import urlsplit

from drivers.address import Address, number_of
from drivers.interface import DriverError

OPTIONS = ("command", "domain", "local", "hz", "joints", "effort", "gravity", "timeout_ms")
EXAMPLE = "ros2:///joint_states?command=/effort_controller/commands"
SPAN = 1e-3, 1e6  # of hz, N m, ms; whatever lies outside is a slip


@dataclass(frozen=True)
class Ros2Settings:
    """Where the arm is and what it is told.

    Attributes:
        states: topic of the joint states; command: of the torques, empty where none is given.
        domain: of DDS; local: on this machine only.
        hz: of the joint states.
        joints: the order of a command's numbers, as in the controller's parameter `joints`; ()
            for that of the driver.
        effort: limits, N m, in the same order; () where the robot's description has to tell them.
        gravity: the arm carries its own weight.
        timeout_s: silence after which the arm is given up.
    """

    states: str
    command: str
    domain: int
    local: bool
    hz: float
    joints: tuple[str, ...]
    effort: tuple[float, ...]
    gravity: bool
    timeout_s: float


def parse(address: str) -> Ros2Settings:
    """Raises DriverError for an address that says nothing, or something unknown."""
    parts = urlsplit(address)
    if parts.netloc or len(parts.path) < 2:
        raise DriverError(f"'{address}' names no topic; write {EXAMPLE} (three slashes)")
    place = Address.of(f"ros2://ros?{parts.query}", OPTIONS)
    options, command = place.options, place.options.get("command", "")
    if command and not command.startswith("/"):
        raise DriverError(f"'{address}': command={command} is no topic; as in {EXAMPLE}")
    domain = options.get("domain", os.environ.get("ROS_DOMAIN_ID") or "0")
    if not domain.isdecimal() or int(domain) > 232:
        raise DriverError(f"'{address}': domain {domain} is not a number from 0 to 232")
    joints = tuple(x for x in options.get("joints", "").split(",") if x)
    effort = tuple(number_of("effort", x, *SPAN) for x in options.get("effort", "").split(",") if x)
    return Ros2Settings(
        states=parts.path,
        command=command,
        domain=int(domain),
        local=place.flag("local"),
        hz=place.number("hz", 1000.0, *SPAN),
        joints=joints,
        effort=effort,
        gravity=place.flag("gravity"),
        timeout_s=1e-3 * place.number("timeout_ms", 200.0, *SPAN),
    )
