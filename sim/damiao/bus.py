"""The boards' end of a bus, with settings that hold between processes of one machine."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import select
import socket
import time
from collections import deque

import can
from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

from sim.damiao.codec import REFRESH, SERVICE_ID, data_frame

INTERFACES = ("udp_multicast", "socketcan")
MULTICAST_GROUP = "239.74.163.2"  # python-can's default IPv4 group
MULTICAST_PORT = 43113  # python-can's default port


class BoardsMulticastBus(UdpMulticastBus):
    """Sends and receives what every udp_multicast bus of python-can does, own frames excepted."""

    def __init__(self, channel: str, port: int, fd: bool) -> None:
        """Join a group. Raises can.CanInitializationError."""
        super().__init__(channel, port=port, hop_limit=0, fd=fd)  # frames do not leave the machine
        self._fd, self._to = fd, (channel, port)
        self._own: deque[bytes] = deque(maxlen=256)  # that may be under way
        self._socket = socket.socket(fileno=os.dup(self.fileno()))
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to the group. Raises can.CanOperationError."""
        data = pack_message(msg)
        self._own.append(data)
        try:
            self._socket.sendto(data, self._to)
        except OSError as error:
            self._own.pop()
            raise can.CanOperationError(f"cannot send to the group: {error}") from error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame of somebody else within `timeout` s; None if there is none.

        Raises can.CanOperationError for bytes that are no frame.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                data = self._socket.recv(4096, socket.MSG_DONTWAIT)
            except BlockingIOError:
                left_s = None if end is None else end - time.monotonic()
                if left_s is not None and left_s <= 0.0:
                    return None
                select.select([self._socket], [], [], left_s)
                continue
            except OSError as error:
                raise can.CanOperationError(f"cannot receive from the group: {error}") from error
            if data in self._own:
                while self._own.popleft() != data:
                    continue
                continue
            try:
                message = unpack_message(data, check=True)
            except Exception as error:  # msgpack raises ValueErrors, own classes and RecursionError
                raise can.CanOperationError("a datagram that is no frame came") from error
            if self._fd or not message.is_fd:
                return message

    def shutdown(self) -> None:
        """Leave the group."""
        self._socket.close()
        super().shutdown()


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
        try:
            group = ipaddress.ip_address(channel)
        except ValueError:
            group = None
        if group is None or not group.is_multicast:
            raise ValueError(f"'{channel}' is no multicast address; try {MULTICAST_GROUP}")
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
    end = time.monotonic() + 0.2  # s
    while (left_s := end - time.monotonic()) > 0:
        message = bus.recv(left_s)
        if message is not None and message.arbitration_id == reply_id:
            raise ValueError(
                f"another arm answers as motor {motor_id} on this bus; stop it or choose another "
                "channel or port"
            )


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
