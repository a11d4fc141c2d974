"""A python-can bus as the driver uses it: open with clear errors, send, take all that waits."""

from __future__ import annotations

import contextlib
import os
import socket
import struct

import can
import msgpack
from can.interfaces.udp_multicast import UdpMulticastBus

from drivers.damiao.settings import MULTICAST, VIRTUAL, BusSettings
from drivers.interface import DriverError

BATCH_LIMIT = 512  # frames in one go; a babbling bus must not stop the loop
TIMESPEC = struct.Struct("@ll")  # of SO_TIMESTAMPNS
UNREADABLE = -1  # in place of an id: bytes that are no CAN frame
ERROR_FRAME, NOT_A_REPLY = 1, 2

# id, data, seconds on the interface's clock, what kind of frame (0: an ordinary one)
Frame = tuple[int, bytes | bytearray, float, int]


class Wire:
    """The frames of any python-can bus, taken one by one."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus

    def waiting(self) -> list[Frame]:
        """All frames that wait, at most `BATCH_LIMIT`, without waiting for any.

        Raises can.CanError or OSError where the bus is gone.
        """
        frames: list[Frame] = []
        recv = self.bus.recv
        while len(frames) < BATCH_LIMIT:
            message = recv(0)
            if message is None:
                break
            kind = 0
            if message.is_error_frame:
                kind = ERROR_FRAME
            elif message.is_extended_id or message.is_remote_frame:
                kind = NOT_A_REPLY
            frames.append((message.arbitration_id, message.data, message.timestamp, kind))
        return frames

    def close(self) -> None:
        """Close what was opened besides the bus: nothing."""


class MulticastWire(Wire):
    """The frames of python-can's udp_multicast bus, read from its socket.

    python-can takes 13 us for a frame, builds a Message and stops at the first datagram that is
    no frame. This takes 4 us.
    """

    def __init__(self, bus: can.BusABC) -> None:
        super().__init__(bus)
        self._socket = socket.socket(fileno=os.dup(bus.fileno()))
        with contextlib.suppress(OSError):  # the kernel's usual 200 kB last for 256 frames
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)

    def waiting(self) -> list[Frame]:
        """See `Wire`."""
        frames: list[Frame] = []
        recvmsg = self._socket.recvmsg
        while len(frames) < BATCH_LIMIT:
            try:
                data, ancillary, _, _ = recvmsg(4096, 128, socket.MSG_DONTWAIT)  # bytes
            except BlockingIOError:
                break
            stamp_s = 0.0
            for _, _, stamp in ancillary:
                if len(stamp) == TIMESPEC.size:
                    seconds, nanoseconds = TIMESPEC.unpack(stamp)
                    stamp_s = seconds + 1e-9 * nanoseconds
            frames.append(unpack_datagram(data, stamp_s))
        return frames

    def close(self) -> None:
        """Close the second handle on the socket."""
        self._socket.close()


def unpack_datagram(data: bytes, stamp_s: float) -> Frame:
    """A frame from a datagram of python-can's udp_multicast bus.

    Its id is `UNREADABLE` where the bytes are not what python-can sends.
    """
    try:
        said = msgpack.unpackb(data)
        can_id, payload = said["arbitration_id"], said["data"]
        kind = 0
        if said["is_error_frame"]:
            kind = ERROR_FRAME
        elif said["is_extended_id"] or said["is_remote_frame"]:
            kind = NOT_A_REPLY
    except Exception:  # msgpack raises ValueErrors, own classes and RecursionError
        return UNREADABLE, b"", stamp_s, NOT_A_REPLY
    if type(can_id) is not int or type(payload) is not bytes or can_id < 0:
        return UNREADABLE, b"", stamp_s, NOT_A_REPLY
    return can_id, payload, stamp_s, kind


def wire_of(bus: can.BusABC) -> Wire:
    """The fastest way to take the frames of this bus."""
    return MulticastWire(bus) if isinstance(bus, UdpMulticastBus) else Wire(bus)


def open_bus(settings: BusSettings) -> can.BusABC:
    """Open the bus. Raises DriverError in one sentence that says what is missing."""
    what = f"{settings.interface} channel '{settings.channel}'"
    options: dict[str, object] = {}
    if settings.interface == MULTICAST:
        options = {"port": settings.port, "hop_limit": 0, "fd": settings.fd}
    elif settings.interface == "socketcan":
        options = {"fd": settings.fd}
    elif settings.interface != VIRTUAL:
        options = {"bitrate": settings.bitrate}
        if settings.fd:
            options |= {"fd": True, "data_bitrate": settings.data_bitrate}
    try:
        return can.Bus(channel=settings.channel, interface=settings.interface, **options)  # type: ignore[arg-type]
    except can.CanInterfaceNotImplementedError as error:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        if settings.interface not in can.VALID_INTERFACES:
            raise DriverError(
                f"no CAN interface '{settings.interface}'; python-can has: {known}"
            ) from error
        raise DriverError(
            f"{what} needs software that is not installed ({error}); install what python-can's "
            "page on that interface names"
        ) from error
    except OSError as error:
        raise DriverError(f"{what} cannot be opened: {_os_advice(settings, error)}") from error
    except (can.CanError, ValueError, TypeError) as error:
        raise DriverError(f"{what} cannot be opened: {error}; check the address") from error


def message_for(settings: BusSettings, can_id: int, data: bytes) -> can.Message:
    """A frame to send, of the kind that the bus speaks."""
    return can.Message(
        arbitration_id=can_id,
        data=data,
        is_extended_id=False,
        is_fd=settings.fd,
        bitrate_switch=settings.fd,
    )


def _os_advice(settings: BusSettings, error: OSError) -> str:
    if settings.interface != "socketcan":
        return f"{error}; is the adapter plugged in and its library installed?"
    if error.errno == 97:  # EAFNOSUPPORT
        return "this kernel has no CAN; use one with the modules can and can_raw"
    if error.errno == 19:  # ENODEV
        return (
            "no such device; plug the adapter in and bring it up: ip link set "
            f"{settings.channel} up type can bitrate {settings.bitrate}"
            + (f" dbitrate {settings.data_bitrate} fd on" if settings.fd else "")
        )
    if error.errno == 1:  # EPERM
        return "not permitted; run it as a user who may open CAN sockets"
    return f"{error}; is it up? ip link set {settings.channel} up"
