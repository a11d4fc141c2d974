"""A CAN line in virtual time: a host and the boards in lockstep, faster than the clock.

Every frame takes the time of its bits, usual stuff bits included. When the line is free the frame
with the lowest id goes first, out of the oldest of the host and all those of the motors: at 1 kHz
the seven commands come first, then the seven replies. Motors measure when their command has
arrived.

A loop at 1 kHz, here of a driver that takes a bus and a clock; `boards.world` knows the truth:

    line = Line()
    boards = Boards(line.boards, build("nominal"), now_ns=line.now_ns)
    line.attach(boards)
    arm = SomeDriver(bus=line.host, now_ns=line.now_ns)
    with line.eager():
        arm.connect()  # asks and waits, outside the loop
    start_ns = line.next_whole_ns(1_000_000)
    for k in range(1000):
        line.advance_to(start_ns + k * 1_000_000)
        arm.command(law(arm.read()))

Sending takes no virtual time. `recv` with a time-out lets virtual time pass until a frame is
there or the time is over; without a time-out it returns what has arrived by now. While the line
is eager a `recv` without a time-out lets time pass as well, as long as frames are under way.
"""

from __future__ import annotations

import contextlib
import errno
import heapq
from collections import deque
from collections.abc import Iterator
from copy import copy
from typing import Protocol

import can

from sim.faults import Faults

BITRATE, DATA_BITRATE = 1_000_000, 5_000_000  # bit/s, OpenArm's
START_NS = 1_000_000_000
FAR_NS = 1 << 62

STUFFED = 0.084  # stuff bits for each bit that may need one, on average over commands and replies


def frame_ns(message: can.Message) -> int:
    """Typical time of an 11-bit frame, 16 bytes or less, and the gap after it, ns (ISO 11898-1)."""
    if message.is_error_frame:
        # flag 6, echo of the others up to 6, delimiter 8, gap 3
        return round(23 * 1e9 / BITRATE)
    data = 8 * len(message.data)
    if not message.is_fd:
        return round((47 + data + STUFFED * (34 + data)) * 1e9 / BITRATE)
    # From ESI to the checksum, which has stuff bits at fixed places, a switched frame is faster.
    fast = DATA_BITRATE if message.bitrate_switch else BITRATE
    # 30 bits are outside of what a bit-rate switch speeds up, with one stuff bit
    return round((30 / BITRATE + (33 + data + STUFFED * (5 + data)) / fast) * 1e9)


class Node(Protocol):
    """Who listens on the far end."""

    def service(self) -> int:
        """Handle the frames that have arrived."""

    def next_ns(self) -> int | None:
        """When it sends unasked; None for never."""


class LineEnd(can.BusABC):
    """One end of a line.

    Attributes:
        arrived: frames that are complete and were not received yet.
    """

    def __init__(self, line: Line, name: str, fd: bool) -> None:
        """Belongs to a line, which makes both."""
        self._line, self.arrived = line, deque[can.Message]()
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self.channel_info = f"simulated CAN line, end of the {name}"
        super().__init__(channel=name)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a frame. Raises CanOperationError where it cannot be sent."""
        self._line.queue(self, msg)

    def recv(self, timeout: float | None = 0.0) -> can.Message | None:
        """The oldest frame that has arrived; lets virtual time pass up to `timeout` s for one."""
        if not self.arrived:
            self._line.wait(self, round((timeout or 0.0) * 1e9))
        while self.arrived:
            message = self.arrived.popleft()
            if self._matches_filters(message):
                return message
        return None


class Line:
    """Two ends, a wire, and a clock that only moves when told.

    Attributes:
        host: the host's end.
        boards: the motors' end.
        start_ns: the clock's first reading.
    """

    def __init__(self, fd: bool = True, faults: Faults | None = None) -> None:
        """Lay the line.

        Args:
            fd: whether FD frames may be sent.
            faults: the boards' own; `enobufs` strikes the host's sends.
        """
        self.host, self.boards = LineEnd(self, "host", fd), LineEnd(self, "motors", fd)
        self.start_ns = START_NS
        self._fd, self._faults = fd, faults
        self._now_ns = self._free_ns = START_NS
        self._node: Node | None = None
        self._from_host: deque[tuple[int, can.Message]] = deque()
        self._from_boards: list[tuple[int, int, int, can.Message]] = []
        self._count, self._eager = 0, False
        self._flying: tuple[int, LineEnd, can.Message] | None = None

    def now_ns(self) -> int:
        """The virtual clock."""
        return self._now_ns

    def attach(self, node: Node) -> None:
        """Let `node` handle what arrives at the motors' end."""
        self._node = node

    def next_whole_ns(self, period_ns: int) -> int:
        """The next instant, from now on, that is whole periods after the start."""
        return self.start_ns + -((self.start_ns - self._now_ns) // period_ns) * period_ns

    @contextlib.contextmanager
    def eager(self) -> Iterator[None]:
        """Inside, whoever receives gets what is under way without asking for time to pass."""
        self._eager = True
        try:
            yield
        finally:
            self._eager = False

    def wait(self, end: LineEnd, for_ns: int) -> None:
        """Let time pass until something arrives at an end, `for_ns` at most.

        While the line is eager also until the last frame under way has arrived.
        """
        if self._eager and end is self.host:
            while not end.arrived and self._next_event() < FAR_NS:
                self.advance_to(self._next_event(), end)
        if for_ns and not end.arrived:
            self.advance_to(self._now_ns + for_ns, end)

    def queue(self, end: LineEnd, message: can.Message) -> None:
        """Take a frame to be sent. Raises CanOperationError."""
        if message.is_fd and not self._fd:
            raise can.CanOperationError("FD frame on a classic line", errno.EINVAL)
        if end is self.boards:
            self._count += 1
            entry = (message.arbitration_id, self._count, self._now_ns, message)
            heapq.heappush(self._from_boards, entry)
            return
        since_s = (self._now_ns - self.start_ns) * 1e-9
        struck = self._faults is not None and self._faults.strikes("enobufs", since_s)
        if struck or len(self._from_host) >= 64:  # frames that its controller holds
            no_room = "Failed to transmit: No buffer space available"  # as socketcan has it
            raise can.CanOperationError(no_room, errno.ENOBUFS)
        own = copy(message)  # the host may change what it sent
        own.is_rx = True
        self._from_host.append((self._now_ns, own))

    def advance_to(self, until_ns: int, awaited: LineEnd | None = None) -> None:
        """Let what is due by an instant, the new present, happen; until `awaited` gets a frame."""
        while awaited is None or not awaited.arrived:
            if self._flying is not None:
                if self._flying[0] > until_ns:
                    break
                self._land(*self._flying)
                continue
            start, due = self._next_start(), self._next_event()
            if due > until_ns:
                break
            self._now_ns = max(due, self._now_ns)
            if due < start:
                assert self._node is not None
                self._node.service()
            else:
                # The ready frame with the lowest id goes onto the wire
                now, waiting = self._now_ns, self._from_boards
                ready = [i for i, entry in enumerate(waiting) if entry[2] <= now]
                index = min(ready, key=waiting.__getitem__, default=-1)
                host = self._from_host and self._from_host[0][0] <= now
                if host and (
                    index < 0 or self._from_host[0][1].arbitration_id <= waiting[index][0]
                ):
                    message, to = self._from_host.popleft()[1], self.boards
                else:
                    message, to = waiting.pop(index)[3], self.host
                    heapq.heapify(waiting)
                took = frame_ns(message)
                self._flying = now + took, to, message
        else:
            return
        self._now_ns = max(until_ns, self._now_ns)

    def _next_event(self) -> int:
        """When something happens unless a frame is sent; far away for never."""
        if self._flying is not None:
            return self._flying[0]
        unasked = self._node.next_ns() if self._node is not None else None
        return min(self._next_start(), FAR_NS if unasked is None else unasked)

    def _next_start(self) -> int:
        """When the next frame starts."""
        ready = [entry[2] for entry in self._from_boards]
        if self._from_host:
            ready.append(self._from_host[0][0])
        return max(min(ready), self._free_ns) if ready else FAR_NS

    def _land(self, end_ns: int, to: LineEnd, message: can.Message) -> None:
        """A frame is complete."""
        self._flying = None
        self._now_ns = self._free_ns = end_ns
        message.timestamp = end_ns * 1e-9  # of the frame's end
        to.arrived.append(message)
        if to is self.boards and self._node is not None:
            self._node.service()
