"""Datagrams of a connection become states, each one accounted for."""

from __future__ import annotations

import socket
import time

from drivers.fci import ledger
from drivers.fci.codec import State, WireError, id_at
from drivers.fci.handshake import Link
from drivers.fci.ledger import Ledger
from drivers.fci.reader import SLOTS
from drivers.interface import Array, DriverError


class StateStream:
    """States of an open link.

    Args:
        link: open.
        account: takes the count of everything.

    Attributes:
        arrived_ns: CLOCK_MONOTONIC, of the last state.
        unsent: commands that the operating system did not take.
    """

    def __init__(self, link: Link, account: Ledger) -> None:
        self._link, self._account = link, account
        self._robot = socket.inet_aton(link.channel.robot_host)
        self._port = 0
        self._restarts = 0
        self._last_refused = ""
        self.arrived_ns = 0
        self.unsent = 0

    @property
    def behind(self) -> bool:
        """A later state than the last one waits."""
        return self._link.feed.newest() is not None

    def next(self, wait_s: float) -> State | None:
        """The next state that counts; None where no datagram came in time. Raises DriverError."""
        feed, account = self._link.feed, self._account
        while True:
            record = feed.next(wait_s)
            if feed.restarts != self._restarts:
                self._restarts = feed.restarts
                account.note("reader", "the process that reads states died; it was replaced")
            if record is None:
                return None
            account.arrived(record)
            reason: str | None = ledger.STRANGER
            if record.address == self._robot:
                try:
                    state = self._link.decoder.decode(feed.data, record.start, record.length)
                    reason = account.judge(state.message_id, record, time.monotonic_ns())
                except WireError as error:
                    self._last_refused, reason = f" ({error})", ledger.MALFORMED
            if reason is None:
                self._port, self.arrived_ns = record.port, record.arrived_ns
                return state
            account.refuse(reason, record)
            if account.useless(record):
                raise DriverError(
                    f"for 1 s the robot has sent nothing of use, the last was {reason}"
                    f"{self._last_refused}: check ?protocol and the network, connect again"
                )

    def answered(self, state: State) -> tuple[int, Array]:
        """What a command computed from this state answers: an id, and the torque accepted there.

        Where later states wait already, the robot is past this one and drops an answer to it;
        the command is the best there is for the newest of them.
        """
        feed = self._link.feed
        start = feed.newest()
        if start is not None:
            newest = id_at(feed.data, start)
            if 0 < newest - state.message_id <= SLOTS + ledger.SLACK_TICKS:
                return newest, self._link.decoder.accepted(feed.data, start)
        return state.message_id, state.tau_J_d

    def send(self, datagram: bytearray) -> None:
        """Send a command to where the last state came from."""
        where = (self._link.channel.robot_host, self._port)
        try:
            self._link.udp.sendto(datagram, socket.MSG_DONTWAIT, where)
        except OSError as error:
            self.unsent += 1
            self._account.note("unsent", f"the network did not take a command ({error})")

    def silence(self) -> str:
        """Why no state came, as far as can be told."""
        try:
            self._link.channel.poll()
        except WireError as error:
            return f"the robot answers on TCP with {error}: connect again"
        if self._link.channel.closed:
            return (
                "no state for 1 s and the robot has cut the connection: it was switched off, FCI "
                "was deactivated in Desk, or another client took over"
            )
        return (
            "no state for 1 s while the connection stands: check the cable, a firewall that "
            "blocks UDP, and whether another client took over"
        )
