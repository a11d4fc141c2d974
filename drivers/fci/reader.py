"""A process that does nothing but take datagrams from a socket and put them into a ring.

Run by its path, as `python -I -S reader.py UDP EVENT ALIVE MEMORY BEFORE STATE_SIZE PARENT CORES`
(five descriptors it inherits, the fifth -1 for none, and numbers), and with the standard library
only, so that it is ready within a few hundredths of a second. Its interpreter serves no other
thread: a busy one in the driver's process costs no datagram.

The ring lies in shared memory. The kernel writes a datagram straight into a slot; then the head is
moved on and the driver is woken. The reader moves the head only, the driver the tail only, and both
are aligned words. Where the ring is full, datagrams are dropped and the next record tells how many
were. A reader that is killed leaves a sound ring behind for the next one, a spare: it has started
long before and waits until BEFORE, the pipe that the other holds, hangs up. No robot waits as long
as a process needs to start.
"""

from __future__ import annotations

import contextlib
import gc
import mmap
import os
import select
import socket
import struct
import sys
import time

SLOTS = 1024  # a second of states
HEAD, TAIL, READY = 0, 8, 16  # words of the ring, each in a cache line of its own
FIRST_SLOT = 4096
_LINE = 64
# Of a record, before its datagram: port and address of the sender, length of the datagram, drops
# by the kernel since the socket was opened, drops here since the last record, arrival
# (CLOCK_MONOTONIC, ns).
RECORD = struct.Struct("@H2x4sIIIxxxxq")
SO_TIMESTAMPNS, SO_RXQ_OVFL = 35, 40  # <asm-generic/socket.h>
TIME_OUT_S = 0.25  # between two looks whether the driver still lives
_TIMESPEC = struct.Struct("@qq")
_COUNT = struct.Struct("@I")


def slot_size(state_size: int) -> int:
    """Bytes from one record to the next."""
    return -(-(RECORD.size + state_size) // _LINE) * _LINE


def ring_size(state_size: int) -> int:
    """Bytes of the shared memory."""
    return FIRST_SLOT + SLOTS * slot_size(state_size)


def words_of(memory: mmap.mmap) -> memoryview:
    """The ring's words; each is read and written at once, where `struct` writes a zero first."""
    return memoryview(memory)[:FIRST_SLOT].cast("Q")


def arrival_ns(wall_ns: int) -> int:
    """A kernel's receive time of CLOCK_REALTIME as CLOCK_MONOTONIC; now where it cannot be."""
    now_ns = time.monotonic_ns()
    waited_ns = time.time_ns() - wall_ns
    if 0 <= waited_ns <= 2_000_000_000:  # in the socket's buffer; beyond, the wall clock has jumped
        return now_ns - waited_ns
    return now_ns


class StateRing:
    """The reader's end of the ring.

    Args:
        memory: shared, of `ring_size`.
        state_size: bytes of a state.
    """

    def __init__(self, memory: mmap.mmap, state_size: int) -> None:
        self._memory, self._words = memory, words_of(memory)
        step = slot_size(state_size)
        view = memoryview(memory)
        self._starts = range(FIRST_SLOT, FIRST_SLOT + SLOTS * step, step)
        self._spaces = [
            [view[start + RECORD.size : start + RECORD.size + state_size]] for start in self._starts
        ]
        self._nowhere = [memoryview(bytearray(state_size))]
        self._head, self._tail = self._words[HEAD], self._words[TAIL]
        self.dropped = 0

    def space(self) -> list[memoryview]:
        """Where the next datagram goes; nowhere while the ring is full."""
        if self._head - self._tail >= SLOTS:
            self._tail = self._words[TAIL]
            if self._head - self._tail >= SLOTS:
                return self._nowhere
        return self._spaces[self._head % SLOTS]

    def put(
        self, space: list[memoryview], source: tuple[int, bytes], length: int, drops: int, at: int
    ) -> bool:
        """Complete the record of a datagram that went into `space`; False where it is lost."""
        if space is self._nowhere:
            self.dropped += 1
            return False
        start = self._starts[self._head % SLOTS]
        RECORD.pack_into(self._memory, start, *source, length, drops, self.dropped, at)
        self._words[HEAD] = self._head = self._head + 1
        self.dropped = 0
        return True


def serve(udp: socket.socket, ring: StateRing, event: int, parent: int, state_size: int) -> None:
    """Pass on datagrams until the parent is gone."""
    room = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)
    sender, source = ("", 0), (0, bytes(4))
    kernel_drops = 0
    while True:
        space = ring.space()
        try:
            length, extras, flags, address = udp.recvmsg_into(space, room)
        except BlockingIOError:
            if os.getppid() != parent:
                return
            continue
        arrived_ns = 0
        for _, kind, data in extras:
            if kind == SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack_from(data)
                arrived_ns = arrival_ns(seconds * 1_000_000_000 + nanoseconds)
            elif kind == SO_RXQ_OVFL:
                kernel_drops = _COUNT.unpack_from(data)[0]
        if flags & socket.MSG_TRUNC:
            length = state_size + 1  # longer than a state, whatever it was
        if address != sender:
            sender, source = address, (address[1], socket.inet_aton(address[0]))
        if ring.put(space, source, length, kernel_drops, arrived_ns or time.monotonic_ns()):
            os.eventfd_write(event, 1)
        elif os.getppid() != parent:
            return


def gone(before: int, parent: int) -> bool:
    """Wait until the reader before is gone; False where the parent went first."""
    poll = select.poll()
    poll.register(before, 0)  # hanging up is always told
    while not poll.poll(1e3 * TIME_OUT_S):
        if os.getppid() != parent:
            return False
    return True


def main(arguments: list[str]) -> None:
    """Serve the descriptors named on the command line."""
    udp, event, _alive, memory, before, state_size, parent = map(int, arguments[:7])
    gc.disable()  # nothing here makes cycles
    with contextlib.suppress(OSError):  # a core taken away meanwhile: any other will do
        os.sched_setaffinity(0, map(int, arguments[7].split(",")))
    with contextlib.suppress(OSError):  # not permitted: an ordinary priority has to do
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(75))  # above the loop
    shared = mmap.mmap(memory, ring_size(state_size))
    if before >= 0 and not gone(before, parent):
        return
    ring = StateRing(shared, state_size)
    words_of(shared)[READY] = 1
    os.eventfd_write(event, 1)
    serve(socket.socket(fileno=udp), ring, event, parent, state_size)


if __name__ == "__main__":
    main(sys.argv[1:])
