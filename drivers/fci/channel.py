"""The FCI's TCP channel: requests out, replies in, without ever waiting for ever."""

from __future__ import annotations

import select
import socket
import time
from collections import deque

from drivers.fci import messages
from drivers.fci.codec import WireError
from drivers.interface import DriverError

CONNECT_LIMIT_S = 5.0
_CHUNK = 1 << 16


class Channel:
    """A connection to the robot.

    Args:
        host, port: of the robot.

    Attributes:
        local_host, robot_host: IPv4 addresses of the two ends.
        closed: the robot has ended the connection.
    """

    def __init__(self, host: str, port: int) -> None:
        where = f"{host}:{port}"
        try:
            self._tcp = socket.create_connection(
                (socket.gethostbyname(host), port), CONNECT_LIMIT_S
            )
        except ConnectionRefusedError as error:
            raise DriverError(
                f"no FCI at {where}: switch the robot on, unlock its brakes and activate FCI in "
                "Desk"
            ) from error
        except TimeoutError as error:
            raise DriverError(
                f"nobody answers at {where}: check the address, the cable and this computer's "
                "network settings"
            ) from error
        except OSError as error:
            raise DriverError(f"cannot reach {where} ({error}): check the address") from error
        self._tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._tcp.setblocking(False)
        self.local_host: str = self._tcp.getsockname()[0]
        self.robot_host: str = self._tcp.getpeername()[0]
        self.closed = False
        self._parser = messages.ReplyParser()
        self._replies: dict[int, deque[bytes]] = {}
        self._next_id = 0

    def send(self, command: int, payload: bytes = b"") -> int:
        """Send a request and do not wait; its command id. Raises DriverError."""
        command_id, self._next_id = self._next_id, self._next_id + 1
        data = messages.request(command, command_id, payload)
        try:
            sent = self._tcp.send(data)
        except OSError as error:
            self.closed = True
            raise DriverError(f"the robot takes no request ({error}): connect again") from error
        if sent < len(data):
            raise DriverError("the robot does not read its requests: connect again")
        self._replies[command_id] = deque()
        return command_id

    def poll(self) -> None:
        """Take what has arrived. Raises WireError for what no robot says."""
        while not self.closed:
            try:
                data = self._tcp.recv(_CHUNK)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self.closed = True
                return
            try:
                replies = self._parser.feed(data)
            except WireError:
                self.closed = True  # the stream cannot be read any further
                raise
            for reply in replies:
                if reply.command_id in self._replies:
                    self._replies[reply.command_id].append(reply.payload)

    def take(self, command_id: int) -> bytes | None:
        """The next reply to a request, where one has been taken in."""
        replies = self._replies.get(command_id)
        return replies.popleft() if replies else None

    def wait(self, command_id: int, limit_s: float) -> bytes | None:
        """The next reply to a request; None where none comes in time or the robot hung up."""
        deadline = time.monotonic() + limit_s
        while True:
            self.poll()
            reply = self.take(command_id)
            left_s = deadline - time.monotonic()
            if reply is not None or self.closed or left_s <= 0.0:
                return reply
            select.select([self._tcp], [], [], left_s)

    def close(self) -> None:
        """Hang up; may be called more than once."""
        self.closed = True
        self._tcp.close()
