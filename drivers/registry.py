"""A driver by its address: `pybullet:panda`, `log:FILE.mcap`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from drivers.interface import Driver, DriverError
from drivers.log import LogArm

Builder = Callable[[str], Driver]
SCHEMES = ("log", "pybullet")


def split_address(address: str) -> tuple[str, str]:
    """(scheme, rest) of an address. Raises DriverError for one without a scheme."""
    scheme, colon, rest = address.partition(":")
    if not colon or not rest:
        raise DriverError(
            f"'{address}' is no driver address; write SCHEME:WHAT, as in pybullet:panda"
        )
    return scheme, rest


def open_driver(
    address: str, builders: Mapping[str, Builder], joint_names: Sequence[str] | None = None
) -> Driver:
    """The driver that an address names, not connected yet.

    Args:
        address: SCHEME:WHAT.
        builders: of the schemes that need more than their address (a simulated arm needs its
            plant), by scheme.
        joint_names: joints wanted of a recording, in this order.

    Raises:
        DriverError: no such scheme (names the choices), or the driver cannot be built.
    """
    scheme, rest = split_address(address)
    known: dict[str, Builder] = {"log": lambda path: LogArm(path, joint_names), **builders}
    if scheme not in known:
        raise DriverError(f"no driver '{scheme}'; have: {', '.join(SCHEMES)}")
    return known[scheme](rest)
