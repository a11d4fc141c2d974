"""One connected client: its requests over TCP, its datagrams over UDP; nothing blocks."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress

from sim.fci.layout import COMMAND_BYTES, RobotCommand, read_command
from sim.fci.requests import BadRequest, Request, RequestReader

CHUNK = 4096  # bytes at a time; the longest request has 428
MOST_HELD = 16 << 20  # bytes of replies that a client does not fetch, then it is dropped
QUEUE = 64  # datagrams looked at per tick: more would be a flood, not a robot's client


class Session:
    """A client from its TCP connection to its end.

    Attributes:
        open: the connection stands.
        connected: the Connect request has succeeded; states are sent.
        foreign: datagrams that were no command of this version.
        stale: commands for a state other than the last one.
    """

    def __init__(self, tcp: socket.socket, version: int) -> None:
        tcp.setblocking(False)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._tcp, self._version = tcp, version
        self._udp: socket.socket | None = None
        self._reader, self._out = RequestReader(version), bytearray()
        self.open, self.foreign, self.stale = True, 0, 0

    @property
    def connected(self) -> bool:
        """States are sent."""
        return self.open and self._udp is not None

    def fileno(self) -> int:
        """Of the TCP connection, for select."""
        return self._tcp.fileno()

    def begin_states(self, port: int) -> None:
        """Send states to this UDP port of the client."""
        own, peer = self._tcp.getsockname()[0], self._tcp.getpeername()[0]
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.setblocking(False)
        self._udp.bind((own, 0))
        self._udp.connect((peer, port))

    def requests(self, answer: Callable[[Request], bytes | None]) -> None:
        """Answer what has come in over TCP; a client that leaves or talks nonsense is dropped."""
        try:
            data = self._tcp.recv(CHUNK)
            if not data:
                self.close()
                return
            for request in self._reader.feed(data):
                said = answer(request)
                if said is not None:
                    self.reply(said)
        except BlockingIOError:
            pass
        except (OSError, BadRequest):
            self.close()
        if self._out:
            self._flush()

    def reply(self, data: bytes) -> None:
        """Send over TCP, now or when the client's buffer has room again."""
        self._out += data
        self._flush()
        if len(self._out) > MOST_HELD:
            self.close()

    def send(self, state: bytes | bytearray) -> None:
        """One datagram; one that the system does not take is lost, as on a network."""
        if self._udp is None:
            return
        with suppress(OSError):  # buffer full, or nobody listens at that port (any more)
            self._udp.send(state)

    def command(self, message_id: int) -> RobotCommand | None:
        """The command that answers the last state, if it is there."""
        found = None
        if self._udp is None:
            return None
        for _ in range(QUEUE):
            try:
                data = self._udp.recv(COMMAND_BYTES[10] + 1)
            except BlockingIOError:
                break
            except OSError:  # an earlier state found nobody at the client's port
                continue
            command = read_command(data, self._version)
            if command is None:
                self.foreign += 1
            elif command.message_id == message_id:
                found = command
            else:
                self.stale += 1
        return found

    def close(self) -> None:
        """End both connections; may be called more than once."""
        self.open = False
        self._tcp.close()
        if self._udp is not None:
            self._udp.close()

    def _flush(self) -> None:
        if not self.open:
            return
        try:
            sent = self._tcp.send(self._out)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        del self._out[:sent]
