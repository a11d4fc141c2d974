"""A driver by its address: `pybullet:panda`, `log:FILE.mcap`, `fci://HOST`, `can://CHANNEL?...`,
`ros2:///TOPIC?...`, or `FILE.py:CLASS` of the user's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlsplit

from drivers.errors import DriverError, choices

if TYPE_CHECKING:
    from drivers.interface import Driver

Builder = Callable[[str], "Driver"]
# Loaded by name when one is opened: no arm needs the libraries of another, and an address that is
# wrong is told before anything is loaded.
LOG = ".files.log:LogArm"  # takes (file, joint names)
# Behind these an arm may be real; take (address, joint names, whether the arm may be moved).
HARDWARE = {"fci": ".fci.arm:FciArm", "can": ".damiao.arm:DamiaoArm", "ros2": ".ros2.arm:Ros2Arm"}
NAMELESS = ("can", "ros2")  # of these, arms that cannot tell which robot they are
SCHEMES = ("log", "pybullet", *HARDWARE)
OWN_KIND = " or FILE.py:CLASS of your own"


def split_address(address: str) -> tuple[str, str]:
    """(scheme, rest) of an address. Raises DriverError for one without a scheme."""
    scheme, colon, rest = address.partition(":")
    if not colon or not rest:
        raise DriverError(
            f"'{address}' is no driver address; write SCHEME:WHAT, as in pybullet:panda, "
            "fci://172.16.0.2, can://can0?interface=socketcan or ros2:///joint_states, or "
            "my_arm.py:MyArm, a driver of your own"
        )
    return scheme, rest


def is_own(scheme: str) -> bool:
    """Whether a driver is a class in a file of the user's."""
    return scheme.endswith(".py")


def maybe_real(scheme: str) -> bool:
    """Whether an arm may be real behind such a driver."""
    return scheme in HARDWARE or is_own(scheme)


def tells_no_robot(scheme: str) -> bool:
    """Whether an arm behind such a driver cannot tell which robot it is."""
    return scheme in NAMELESS or is_own(scheme)


def open_driver(
    address: str,
    builders: Mapping[str, Builder],
    joint_names: Sequence[str] | None = None,
    allow_motion: bool = False,
) -> Driver:
    """The driver that an address names, not connected yet.

    Args:
        address: SCHEME:WHAT, or FILE.py:CLASS.
        builders: of the schemes that need more than their address (a simulated arm needs its
            plant), by scheme; they take what follows the colon.
        joint_names: joints wanted of a recording, in this order; names of an arm's joints.
        allow_motion: whether an arm that may be real may be moved.

    Raises:
        DriverError: no such scheme (names the choices), or the driver cannot be built.
    """
    scheme, rest = split_address(address)
    if scheme in builders:
        return builders[scheme](rest)
    if scheme == "log":
        return _load(LOG)(rest, joint_names)
    if is_own(scheme):
        return _load(".own:open_own")(address, joint_names, allow_motion)
    if scheme not in HARDWARE:
        raise DriverError(f"no driver '{scheme}'; {choices(scheme, SCHEMES, OWN_KIND)}")
    return _load(HARDWARE[scheme])(address, joint_names, allow_motion)


def joint_count(address: str) -> int | None:
    """Number of joints of an arm that tells no names; None where nothing says it."""
    scheme, rest = split_address(address)
    if scheme == "fci":
        return 7
    told = dict(parse_qsl(urlsplit(rest).query)).get("joints", "")  # can: a number; ros2: names
    if scheme not in NAMELESS or not told:
        return None
    return int(told) if told.isdecimal() else len([name for name in told.split(",") if name])


def _load(target: str) -> Callable[..., Any]:
    """What "MODULE:NAME" names; the module relative to this package, whatever that is called."""
    module, _, name = target.partition(":")
    return getattr(import_module(module, __package__), name)
