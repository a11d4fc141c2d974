"""Which of the robot's states are taken, and the account of the others.

The robot counts its ticks in `message_id`, one per millisecond, so what is missing is known.
"""

from __future__ import annotations

from drivers.fci.feed import Record
from drivers.interface import Intake

TICK_NS = 1_000_000
STALE_NS = 500_000_000  # a waiting state older than this tells of an absent loop, not of the arm
# States in a row of another count, from which on it is followed: fewer for a later one, since a
# motion does not survive 20 ticks without commands; late datagrams may come many in a row.
NEWER_COUNT_AFTER, OLDER_COUNT_AFTER = 10, 100
SLACK_TICKS = 20  # that a count may be ahead of the time that has passed
USABLE_WITHIN_NS = 1_000_000_000  # a stream of nothing but refused datagrams is no stream

REPEATED, OUT_OF_ORDER, MALFORMED = "repeated", "out_of_order", "malformed"
STRANGER, STALE, TOO_SLOW = "stranger", "stale", "loop_too_slow"
STOPPING, RECOVERING = "stopping", "recovering"  # read by the driver for its own use

_NOTES = {
    REPEATED: "the robot or the network repeated a state; repeated ones are refused",
    OUT_OF_ORDER: "a state came after a later one; such states are refused",
    MALFORMED: "a datagram was no state of this protocol version; such datagrams are refused",
    STRANGER: "a datagram came from another computer than the robot; such datagrams are refused",
    STALE: "the loop was away for over 0.5 s; the states that waited meanwhile are refused",
    TOO_SLOW: "the loop took no states until a second of them waited; those after are refused",
}


class Ledger:
    """Judges the ids of one connection and keeps its `Intake`.

    Attributes:
        intake: the account.
        kernel_drops: datagrams that the kernel dropped because its buffer was full; part of
            `intake.lost`.
    """

    def __init__(self) -> None:
        self.intake = Intake()
        self.kernel_drops = 0
        self._noted: set[str] = set()
        self._id = -1
        self._arrived_ns = 0
        self._unread = 0  # datagrams since the last good one of which only the number is known
        self._other_id, self._others = -1, 0
        self._refused_since_ns = 0

    def note(self, kind: str, sentence: str) -> None:
        """Write a sentence at the first occurrence of its kind."""
        if kind not in self._noted:
            self._noted.add(kind)
            self.intake.notes.append(sentence)

    def arrived(self, record: Record) -> None:
        """Count a record, before anything else is done with it."""
        self.intake.received += 1
        if record.dropped:
            self.intake.received += record.dropped
            self._unread += record.dropped
            self._count(TOO_SLOW, record.dropped)
        if record.kernel_drops != self.kernel_drops:
            self.kernel_drops = record.kernel_drops
            self.note("kernel", "the kernel's buffer for states was full; it dropped some")

    def refuse(self, reason: str, record: Record) -> None:
        """Count a datagram out."""
        if reason == MALFORMED:
            self._unread += 1
        self._count(reason, 1)
        self._refused_since_ns = self._refused_since_ns or record.arrived_ns

    def useless(self, record: Record) -> bool:
        """Nothing but refused datagrams for a second, this one included."""
        since_ns = self._refused_since_ns
        return bool(since_ns) and record.arrived_ns - since_ns > USABLE_WITHIN_NS

    def judge(self, message_id: int, record: Record, now_ns: int) -> str | None:
        """Why a state of this id is refused; None takes it."""
        if message_id != self._id + 1 and self._id >= 0:
            reason = self._judge_jump(message_id, record)
            if reason is not None:
                return reason
        self._id, self._arrived_ns = message_id, record.arrived_ns
        self._unread = self._others = self._refused_since_ns = 0
        return STALE if now_ns - record.arrived_ns > STALE_NS else None

    def _judge_jump(self, message_id: int, record: Record) -> str | None:
        ahead = message_id - self._id
        passed = (record.arrived_ns - self._arrived_ns) // TICK_NS
        if 0 < ahead <= SLACK_TICKS + 2 * passed:
            missing = max(0, ahead - 1 - self._unread)
            self.intake.lost += missing
            if missing:
                self.note("lost", "states got lost between the robot and this program")
            return None
        if self._is_new_count(message_id):
            self.note("count", f"the robot went over to another count, from {message_id} on")
            return None
        if ahead == 0:
            return REPEATED
        return OUT_OF_ORDER if ahead < 0 else MALFORMED

    def _is_new_count(self, message_id: int) -> bool:
        """Whether a run of ids apart from ours is long enough to be followed."""
        ahead = message_id - self._other_id
        if 0 <= ahead <= SLACK_TICKS:
            self._others += ahead > 0
        else:
            self._others = 1
        self._other_id = message_id
        needed = NEWER_COUNT_AFTER if message_id > self._id else OLDER_COUNT_AFTER
        return self._others >= needed

    def _count(self, reason: str, number: int) -> None:
        self.intake.refused[reason] += number
        if reason in _NOTES:
            self.note(reason, _NOTES[reason])
