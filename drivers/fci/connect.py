"""From an address to an open connection: TCP channel, version, sockets, reader, first reply."""

from __future__ import annotations

import select
import socket
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from drivers.address import Address
from drivers.fci import codec, tables
from drivers.fci.codec import StateDecoder, WireError
from drivers.fci.reader_client import ReaderClient, open_udp
from drivers.interface import DriverError, NotReady

REPLY_LIMIT_S = 5.0
RECOVERY_LIMIT_S = 10.0
AUTO = "auto"
VERSIONS = {AUTO: None, "5": tables.PANDA, "10": tables.FR3}


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
            self._tcp = socket.create_connection((socket.gethostbyname(host), port), timeout=5.0)
        except ConnectionRefusedError as error:
            here = "start `adapter sim fci` and wait until it says that it is ready"
            robot = "switch the robot on, unlock its brakes and activate FCI in Desk"
            advice = here if host in ("127.0.0.1", "localhost") else robot
            raise DriverError(f"no FCI at {where}: {advice}") from error
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
        self._parser = codec.ReplyParser()
        self._replies: dict[int, deque[bytes]] = {}
        self._next_id = 0

    def send(self, command: int, payload: bytes = b"") -> int:
        """Send a request and do not wait; its command id. Raises DriverError."""
        command_id, self._next_id = self._next_id, self._next_id + 1
        data = codec.request(command, command_id, payload)
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
                data = self._tcp.recv(1 << 16)
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


class Target(NamedTuple):
    """What the address asks for.

    Attributes:
        host, port: of the robot.
        version: 5, 10 or None to find out.
        recover: whether to end a reflex at connect.
        options: the others, as texts.
    """

    host: str
    port: int
    version: int | None
    recover: bool
    options: Mapping[str, str]


def parse(address: str) -> Target:
    """What `fci://HOST[:PORT][?protocol=5|10|auto&...]` asks for. Raises DriverError."""
    parts = Address.of(address, ("protocol", "recover", "collision", "load"))
    protocol = parts.options.get("protocol", AUTO)
    if protocol not in VERSIONS:
        raise DriverError(f"'{address}': no protocol {protocol}; have: {', '.join(VERSIONS)}")
    port, recovering = parts.port or tables.PORT, parts.flag("recover")
    return Target(parts.host, port, VERSIONS[protocol], recovering, parts.options)


@dataclass
class Connection:
    """An open connection.

    Attributes:
        version: of the protocol.
        channel: TCP.
        udp: socket of states and commands.
        reader: of states.
        decoder: of these.
    """

    version: int
    channel: Channel
    udp: socket.socket
    reader: ReaderClient
    decoder: StateDecoder

    def close(self) -> None:
        """End all of it."""
        self.reader.close()
        self.udp.close()
        self.channel.close()


def open_connection(target: Target) -> Connection:
    """Connect, in the version that the robot speaks. Raises DriverError.

    Where the address leaves it open, version 5 is tried first. A robot of version 10 refuses
    that and says its own, or it agrees and shows its version in the answer or by its states.
    """
    version = target.version or tables.PANDA
    connection, server = _try(target, version)
    if target.version is None and server == tables.FR3:
        if connection is not None:
            connection.close()
        version = tables.FR3
        connection, server = _try(target, version)
    if connection is None:
        raise DriverError(f"the robot at {target.host} {tables.version_trouble(server, version)}")
    return connection


def _try(target: Target, version: int) -> tuple[Connection | None, int]:
    """(the connection, the robot's version), without a connection where the robot refuses ours."""
    channel = Channel(target.host, target.port)
    try:
        udp = open_udp(channel.local_host)
    except DriverError:
        channel.close()
        raise
    decoder = StateDecoder(version)
    connection = Connection(version, channel, udp, ReaderClient(udp, decoder.size), decoder)
    try:
        connection.reader.start()
        status, server = _ask(connection)
        if status > 1:
            raise DriverError(
                f"the robot at {target.host} answers Connect with status {status}, which is not "
                "defined: check its system version"
            )
        if status == 0 and target.version is None:
            length = connection.reader.next_length(1.0)  # s
            server = tables.FR3 if length == StateDecoder(tables.FR3).size else server
    except BaseException:
        connection.close()
        raise
    if status == 1:
        connection.close()
        return None, server
    return connection, server


def _ask(connection: Connection) -> tuple[int, int]:
    """Status and version of the robot's answer to Connect. Raises DriverError."""
    port = connection.udp.getsockname()[1]
    payload = codec.connect_payload(connection.version, port)
    connect_id = connection.channel.send(tables.CONNECT[connection.version], payload)
    try:
        reply = connection.channel.wait(connect_id, REPLY_LIMIT_S)
        if reply is None and connection.channel.closed:
            raise DriverError(
                f"{connection.channel.robot_host} hung up during the handshake: end other programs "
                "that use the robot and activate FCI in Desk"
            )
        if reply is None:
            raise DriverError(
                f"{connection.channel.robot_host} does not answer Connect within "
                f"{REPLY_LIMIT_S:.0f} s: end other programs that use the robot, or check that this "
                "is an FCI port"
            )
        return codec.connect_reply(reply)
    except WireError as error:
        raise DriverError(
            f"the robot at {connection.channel.robot_host} gives {error}: is this an FCI port?"
        ) from error


def recover(connection: Connection) -> None:
    """Ask for automatic error recovery and wait for the answer. Raises DriverError."""
    begin = time.monotonic()
    recover_id = connection.channel.send(tables.RECOVER[connection.version])
    try:
        reply = connection.channel.wait(recover_id, RECOVERY_LIMIT_S)
        if reply is None:
            passed_s = time.monotonic() - begin
            raise DriverError(f"no answer to the error recovery in {passed_s:.0f} s: use Desk")
        status = codec.status_reply(reply)
    except WireError as error:
        raise DriverError(f"the error recovery gives {error}: use Desk") from error
    name = tables.status_name(tables.RECOVER_STATUS[connection.version], status)
    if name != "success":
        raise NotReady(f"the robot does not recover: {tables.meaning(name)}")
