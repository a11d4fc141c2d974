"""From an address to an open connection: version, sockets, reader, first reply."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass
from typing import NamedTuple

from drivers.address import Address
from drivers.fci import messages, tables
from drivers.fci.channel import Channel
from drivers.fci.codec import StateDecoder, WireError
from drivers.fci.feed import Feed, open_udp
from drivers.interface import DriverError

REPLY_LIMIT_S = 5.0
RECOVERY_LIMIT_S = 10.0
AUTO = "auto"
OPTIONS = ("protocol", "recover")
VERSIONS = {AUTO: None, "5": tables.PANDA, "10": tables.FR3}


class Wanted(NamedTuple):
    """What the address asks for.

    Attributes:
        host, port: of the robot.
        version: 5, 10 or None to find out.
        recover: whether to end a reflex at connect.
    """

    host: str
    port: int
    version: int | None
    recover: bool


def parse(address: str) -> Wanted:
    """What `fci://HOST[:PORT][?protocol=5|10|auto&recover=0|1]` asks for. Raises DriverError."""
    parts = Address.of(address, OPTIONS)
    protocol = parts.options.get("protocol", AUTO)
    if protocol not in VERSIONS:
        raise DriverError(f"'{address}': no protocol {protocol}; have: {', '.join(VERSIONS)}")
    recovering = parts.options.get("recover", "0")
    if recovering not in ("0", "1"):
        raise DriverError(f"'{address}': recover={recovering}; write recover=1 or recover=0")
    return Wanted(parts.host, parts.port or tables.PORT, VERSIONS[protocol], recovering == "1")


@dataclass
class Link:
    """An open connection.

    Attributes:
        version: of the protocol.
        channel: TCP.
        udp: socket of states and commands.
        feed: states.
        decoder: of these.
    """

    version: int
    channel: Channel
    udp: socket.socket
    feed: Feed
    decoder: StateDecoder

    def close(self) -> None:
        """End all of it."""
        self.feed.close()
        self.udp.close()
        self.channel.close()


def open_link(wanted: Wanted) -> Link:
    """Connect, in the version that the robot speaks. Raises DriverError."""
    version = wanted.version or tables.PANDA
    link, server = _try(wanted, version)
    if link is None and wanted.version is None and server == tables.FR3:
        version = tables.FR3
        link, server = _try(wanted, version)
    if link is None:
        raise DriverError(f"the robot at {wanted.host} {tables.version_trouble(server, version)}")
    return link


def _try(wanted: Wanted, version: int) -> tuple[Link | None, int]:
    """(the link, the robot's version), without a link where the versions do not match."""
    channel = Channel(wanted.host, wanted.port)
    try:
        udp = open_udp(channel.local_host)
    except DriverError:
        channel.close()
        raise
    decoder = StateDecoder(version)
    link = Link(version, channel, udp, Feed(udp, decoder.size), decoder)
    try:
        link.feed.start()
        status, server = _ask(link)
        if status > 1:
            raise DriverError(
                f"the robot at {wanted.host} answers Connect with status {status}, which is not "
                "defined: check its system version"
            )
    except BaseException:
        link.close()
        raise
    if status == 1:
        link.close()
        return None, server
    return link, server


def _ask(link: Link) -> tuple[int, int]:
    """Status and version of the robot's answer to Connect. Raises DriverError."""
    port = link.udp.getsockname()[1]
    payload = messages.connect_payload(link.version, port)
    connect_id = link.channel.send(tables.CONNECT[link.version], payload)
    try:
        reply = link.channel.wait(connect_id, REPLY_LIMIT_S)
        if reply is None:
            raise DriverError(_silent(link.channel))
        return messages.connect_reply(reply)
    except WireError as error:
        raise DriverError(
            f"the robot at {link.channel.robot_host} gives {error}: is this an FCI port?"
        ) from error


def _silent(channel: Channel) -> str:
    if channel.closed:
        return (
            f"{channel.robot_host} hung up during the handshake: end other programs that use the "
            "robot and activate FCI in Desk"
        )
    return (
        f"{channel.robot_host} does not answer Connect within {REPLY_LIMIT_S:.0f} s: end other "
        "programs that use the robot, or check that this is an FCI port"
    )


def recover(link: Link) -> None:
    """Ask for automatic error recovery and wait for the answer. Raises DriverError."""
    begin = time.monotonic()
    recover_id = link.channel.send(tables.RECOVER[link.version])
    try:
        reply = link.channel.wait(recover_id, RECOVERY_LIMIT_S)
        if reply is None:
            passed_s = time.monotonic() - begin
            raise DriverError(f"no answer to the error recovery in {passed_s:.0f} s: use Desk")
        status = messages.status_reply(reply)
    except WireError as error:
        raise DriverError(f"the error recovery gives {error}: use Desk") from error
    name = tables.status_name(tables.RECOVER_STATUS[link.version], status)
    if name != "success":
        raise DriverError(f"the robot does not recover: {tables.meaning(name)}")
