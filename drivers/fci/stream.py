"""The robot's states, one after the other: which are taken, and the account of the others.

The robot counts its ticks in `message_id`, one per millisecond, so what is missing is known.
"""

from __future__ import annotations

import socket
import time
from enum import StrEnum

from drivers.fci.codec import State, WireError, id_at
from drivers.fci.connect import Connection
from drivers.fci.reader import SLOTS
from drivers.fci.reader_client import Record
from drivers.interface import Array, DriverError, Intake

TICK_NS = 1_000_000
STALE_NS = 500_000_000  # a waiting state older than this tells of an absent loop, not of the arm
# States in a row of another count, from which on it is followed: fewer for a later one, since a
# motion does not survive 20 ticks without commands; late datagrams may come many in a row.
SLACK_TICKS = 20  # that a count may be ahead of the time that has passed


class Refusal(StrEnum):
    """Why a datagram is not used."""

    REPEATED = "repeated"
    OUT_OF_ORDER = "out_of_order"
    MALFORMED = "malformed"
    STRANGER = "stranger"
    STALE = "stale"
    TOO_SLOW = "loop_too_slow"
    STOPPING = "stopping"  # read by the driver for its own use, as the next
    RECOVERING = "recovering"


_NOTES = {
    Refusal.REPEATED: "the robot or the network repeated a state; repeated ones are refused",
    Refusal.OUT_OF_ORDER: "a state came after a later one; such states are refused",
    Refusal.MALFORMED: "a datagram was no state of this protocol version; such are refused",
    Refusal.STRANGER: "a datagram came from another computer than the robot; such are refused",
    Refusal.STALE: "the loop was away for over 0.5 s; the states that waited meanwhile are refused",
    Refusal.TOO_SLOW: "the loop took no states until a second of them waited; later ones are lost",
}


class StateIntake:
    """Judges the ids of one connection and keeps its `Intake`.

    Attributes:
        intake: the account.
        kernel_drops: datagrams that the kernel dropped because its buffer was full; part of
            `intake.lost`.
        refused_since_ns: when the first of those came that are all refused; 0 after a good one.
    """

    def __init__(self) -> None:
        self.intake = Intake()
        self.kernel_drops = 0
        self._id = -1
        self._arrived_ns = 0
        self._unread = 0  # datagrams since the last good one of which only the number is known
        self._other_id, self._others = -1, 0
        self.refused_since_ns = 0

    def arrived(self, record: Record) -> None:
        """Count a record, before anything else is done with it."""
        self.intake.received += 1
        if record.dropped:
            self.intake.received += record.dropped
            self._unread += record.dropped
            self._count(Refusal.TOO_SLOW, record.dropped)
        if record.kernel_drops != self.kernel_drops:
            self.kernel_drops = record.kernel_drops
            self.intake.note("kernel", "the kernel's buffer for states was full; it dropped some")

    def refuse(self, reason: Refusal, record: Record) -> None:
        """Count a datagram out."""
        if reason == Refusal.MALFORMED:
            self._unread += 1
        self._count(reason, 1)
        self.refused_since_ns = self.refused_since_ns or record.arrived_ns

    def judge(self, message_id: int, record: Record, now_ns: int) -> Refusal | None:
        """Why a state of this id is refused; None takes it."""
        ahead = message_id - self._id
        if ahead != 1 and self._id >= 0:
            passed = (record.arrived_ns - self._arrived_ns) // TICK_NS
            if 0 < ahead <= SLACK_TICKS + 2 * passed:
                missing = max(0, ahead - 1 - self._unread)
                self.intake.lost += missing
                if missing:
                    self.intake.note("lost", "states got lost between the robot and this program")
            elif self._is_new_count(message_id):
                self.intake.note(
                    "count", f"the robot went over to another count, from {message_id} on"
                )
            elif ahead == 0:
                return Refusal.REPEATED
            else:
                return Refusal.OUT_OF_ORDER if ahead < 0 else Refusal.MALFORMED
        self._id, self._arrived_ns = message_id, record.arrived_ns
        self._unread = self._others = self.refused_since_ns = 0
        return Refusal.STALE if now_ns - record.arrived_ns > STALE_NS else None

    def _is_new_count(self, message_id: int) -> bool:
        """Whether a run of ids apart from ours is long enough to be followed."""
        ahead = message_id - self._other_id
        if 0 <= ahead <= SLACK_TICKS:
            self._others += ahead > 0
        else:
            self._others = 1
        self._other_id = message_id
        needed = 10 if message_id > self._id else 100  # in a row
        return self._others >= needed

    def _count(self, reason: Refusal, number: int) -> None:
        self.intake.refused[reason] += number
        if reason in _NOTES:
            self.intake.note(reason, _NOTES[reason])


class StateStream:
    """States of an open connection.

    Args:
        connection: open.
        account: takes the count of everything.

    Attributes:
        arrived_ns: CLOCK_MONOTONIC, of the last state.
    """

    def __init__(self, connection: Connection, account: StateIntake) -> None:
        self._connection, self._account = connection, account
        self._robot = socket.inet_aton(connection.channel.robot_host)
        self._port = 0
        self._restarts = 0
        self._last_refused = ""
        self.arrived_ns = 0
        self._start = 0

    @property
    def behind(self) -> bool:
        """A later state than the last one waits."""
        return self._connection.reader.newest() is not None

    def next(self, wait_s: float) -> State | None:
        """The next state that counts; None where no datagram came in time. Raises DriverError."""
        reader, account = self._connection.reader, self._account
        while True:
            record = reader.next(wait_s)
            if reader.restarts != self._restarts:
                self._restarts = reader.restarts
                account.intake.note("reader", "the process that reads states died; it was replaced")
            if record is None:
                return None
            account.arrived(record)
            reason: Refusal | None = Refusal.STRANGER
            if record.address == self._robot:
                try:
                    state = self._connection.decoder.decode(
                        reader.data, record.start, record.length
                    )
                    reason = account.judge(state.message_id, record, time.monotonic_ns())
                except WireError as error:
                    self._last_refused, reason = f" ({error})", Refusal.MALFORMED
            if reason is None:
                self._port, self.arrived_ns = record.port, record.arrived_ns
                self._start = record.start
                return state
            account.refuse(reason, record)
            since_ns = account.refused_since_ns
            if since_ns and record.arrived_ns - since_ns > 1_000_000_000:
                raise DriverError(
                    f"for 1 s the robot has sent nothing of use, the last was {reason}"
                    f"{self._last_refused}: check ?protocol and the network, connect again"
                )

    def load(self) -> Array:
        """(13,) load in the state that `next` gave last: mass, inertia (9,), centre (3,)."""
        return self._connection.decoder.load(self._connection.reader.data, self._start)

    def answered(self, state: State) -> tuple[int, Array]:
        """What a command computed from this state answers: an id, and the torque accepted there.

        Where later states wait already, the robot is past this one and drops an answer to it;
        the command is the best there is for the newest of them.
        """
        reader = self._connection.reader
        start = reader.newest()
        if start is not None:
            newest = id_at(reader.data, start)
            if 0 < newest - state.message_id <= SLOTS + SLACK_TICKS:
                return newest, self._connection.decoder.accepted(reader.data, start)
        return state.message_id, state.tau_J_d

    def send(self, datagram: bytearray) -> None:
        """Send a command to where the last state came from."""
        where = (self._connection.channel.robot_host, self._port)
        try:
            self._connection.udp.sendto(datagram, socket.MSG_DONTWAIT, where)
        except OSError as error:
            self._account.intake.note("unsent", f"the network did not take a command ({error})")

    def silence(self) -> str:
        """Why no state came, as far as can be told."""
        try:
            self._connection.channel.poll()
        except WireError as error:
            return f"the robot answers on TCP with {error}: connect again"
        if self._connection.channel.closed:
            return (
                "no state for 1 s and the robot has cut the connection: it was switched off, FCI "
                "was deactivated in Desk, or another client took over"
            )
        return (
            "no state for 1 s while the connection stands: check the cable, a firewall that "
            "blocks UDP, and whether another client took over"
        )
