"""The boards' end of a udp_multicast bus, with less work per frame than python-can's own.

python-can hands a sender its own frames back and builds a message of each: at 7000 replies a
second a tenth of a processor for nothing. Here they are known by their bytes and passed over.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections import deque

import can
import msgpack
from can.interfaces.udp_multicast import UdpMulticastBus

DATAGRAM_BYTES = 4096
OWN_FRAMES = 256  # that may be under way
BUFFER_BYTES = 1 << 20  # 0.1 s of frames at 1 kHz; the kernel may grant less
ON_THIS_MACHINE = 0  # hop limit: frames do not leave the machine


class BoardsMulticastBus(UdpMulticastBus):
    """Sends and receives what every udp_multicast bus of python-can does, own frames excepted."""

    def __init__(self, channel: str, port: int, fd: bool) -> None:
        """Join a group. Raises can.CanInitializationError."""
        super().__init__(channel, port=port, hop_limit=ON_THIS_MACHINE, fd=fd)
        self._fd, self._to = fd, (channel, port)
        self._own: deque[bytes] = deque(maxlen=OWN_FRAMES)
        self._socket = socket.socket(fileno=os.dup(self.fileno()))
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame to the group. Raises can.CanOperationError."""
        data = _packed(msg)
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
                data = self._socket.recv(DATAGRAM_BYTES, socket.MSG_DONTWAIT)
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
            message = _unpacked(data)
            if self._fd or not message.is_fd:
                return message

    def shutdown(self) -> None:
        """Leave the group."""
        self._socket.close()
        super().shutdown()


def _packed(message: can.Message) -> bytes:
    """A frame as python-can's buses put it into a datagram."""
    return bytes(
        msgpack.packb(
            {
                "timestamp": 0.0,
                "arbitration_id": message.arbitration_id,
                "is_extended_id": message.is_extended_id,
                "is_remote_frame": message.is_remote_frame,
                "is_error_frame": message.is_error_frame,
                "channel": None,
                "dlc": message.dlc,
                "data": bytes(message.data),
                "is_fd": message.is_fd,
                "bitrate_switch": message.bitrate_switch,
                "error_state_indicator": message.error_state_indicator,
            }
        )
    )


def _unpacked(data: bytes) -> can.Message:
    try:
        return can.Message(**msgpack.unpackb(data), check=True)
    except Exception as error:  # msgpack raises ValueErrors, own classes and RecursionError
        raise can.CanOperationError("a datagram that is no frame came") from error
