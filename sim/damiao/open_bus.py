"""Opens the boards' end of a bus, with settings that hold between processes of one machine."""

from __future__ import annotations

import errno
import ipaddress
import time

import can

from sim.damiao.codec import REFRESH, SERVICE_ID
from sim.damiao.frames import data_frame
from sim.damiao.multicast_bus import BoardsMulticastBus

INTERFACES = ("udp_multicast", "socketcan")
MULTICAST_GROUP = "239.74.163.2"  # python-can's default IPv4 group
MULTICAST_PORT = 43113  # python-can's default port
ASK_S = 0.2


def open_bus(
    interface: str, channel: str, port: int = MULTICAST_PORT, fd: bool = True
) -> can.BusABC:
    """A bus for simulated boards.

    Args:
        interface: one of `INTERFACES`.
        channel: multicast group, or name of a CAN interface.
        port: of the multicast group.
        fd: whether FD frames are understood.

    Raises:
        ValueError: what is missing, in one sentence.
    """
    if interface not in INTERFACES:
        raise ValueError(
            f"no CAN interface '{interface}' for boards of their own; have: {', '.join(INTERFACES)}"
        )
    try:
        if interface == "socketcan":
            return can.Bus(interface=interface, channel=channel, fd=fd)
        _check_group(channel)
        return BoardsMulticastBus(channel, port, fd)
    except (can.CanError, OSError) as error:
        raise ValueError(_advice(interface, channel, error)) from error


def address_of(interface: str, channel: str, port: int, fd: bool) -> str:
    """The address under which a driver finds the boards."""
    where = f"[{channel}]" if ":" in channel else channel
    if interface == "udp_multicast" and port != MULTICAST_PORT:
        where += f":{port}"
    return f"can://{where}?interface={interface}" + ("" if fd else "&fd=0")


def check_alone(bus: can.BusABC, motor_id: int, reply_id: int, fd: bool) -> None:
    """Raise ValueError where somebody already answers for a motor on this bus."""
    bus.send(data_frame(SERVICE_ID, bytes([motor_id, 0, REFRESH, 0, 0, 0, 0, 0]), fd))
    end = time.monotonic() + ASK_S
    while (left_s := end - time.monotonic()) > 0:
        message = bus.recv(left_s)
        if message is not None and message.arbitration_id == reply_id:
            raise ValueError(
                f"another arm answers as motor {motor_id} on this bus; stop it or choose another "
                "channel or port"
            )


def _check_group(channel: str) -> None:
    try:
        group = ipaddress.ip_address(channel)
    except ValueError:
        group = None
    if group is None or not group.is_multicast:
        raise ValueError(f"'{channel}' is no multicast address; try {MULTICAST_GROUP}")


def _advice(interface: str, channel: str, error: Exception) -> str:
    """What to do about a bus that does not open, in one sentence."""
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    number = getattr(cause, "errno", None)
    if interface == "udp_multicast":
        if number in (errno.ENODEV, errno.EADDRNOTAVAIL, errno.ENETUNREACH):
            return (
                f"this machine has no route to the multicast group {channel}; as root: "
                f"ip route add {channel} dev lo"
            )
        return f"the multicast group {channel} cannot be joined: {cause}"
    if number == errno.EAFNOSUPPORT:
        return "this kernel has no CAN; use --interface udp_multicast"
    if number == errno.ENODEV:
        return (
            f"there is no CAN interface '{channel}'; as root: ip link add {channel} type vcan && "
            f"ip link set {channel} mtu 72 up"
        )
    return f"the CAN interface '{channel}' cannot be opened: {cause}"
