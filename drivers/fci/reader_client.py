"""The driver's end of the reader process: starts it, takes its records, starts it again."""

from __future__ import annotations

import mmap
import os
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from typing import NamedTuple

from drivers.fci import reader
from drivers.fci.reader import HEAD, READY, RECORD, SLOTS, TAIL, words_of
from drivers.interface import DriverError

RECEIVE_BUFFER = 4 << 20  # bytes; half a second of states with the kernel's overhead
_SO_RCVBUFFORCE = 33  # <asm-generic/socket.h>; beyond net.core.rmem_max, where permitted
RESTARTS, RESTARTS_WITHIN_S = 5, 10.0


class QuickSwitching:
    """Shortens the interpreter's switch interval while anybody needs it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users, self._before_s = 0, 0.0

    def begin(self) -> None:
        """One more user."""
        with self._lock:
            if self._users == 0:
                self._before_s = sys.getswitchinterval()
                # A thread that wakes up waits this long for the lock; by default five ticks.
                sys.setswitchinterval(min(self._before_s, 50e-6))
            self._users += 1

    def end(self) -> None:
        """One user less; the last one gives the old interval back."""
        with self._lock:
            self._users -= 1
            if self._users == 0:
                sys.setswitchinterval(self._before_s)


QUICK_SWITCHING = QuickSwitching()


class Reader(NamedTuple):
    """A reader process, at work or spare.

    Attributes:
        process: itself.
        alive: a pipe without data, which hangs up when the process dies.
    """

    process: subprocess.Popen[bytes]
    alive: int

    def end(self) -> None:
        """Kill the process and let go of its pipe."""
        self.process.kill()
        self.process.wait()
        os.close(self.alive)


class Record(NamedTuple):
    """A datagram as the reader passed it on.

    Attributes:
        start: of the datagram in `ReaderClient.data`; there until the next record is taken.
        length: of the datagram, bytes; more than a state for anything longer.
        port, address: of the sender, the latter in 4 bytes.
        kernel_drops: by the kernel since the socket was opened, at this datagram.
        dropped: by the reader since its last record, because the ring was full.
        arrived_ns: CLOCK_MONOTONIC.
    """

    start: int
    port: int
    address: bytes
    length: int
    kernel_drops: int
    dropped: int
    arrived_ns: int


def open_udp(host: str) -> socket.socket:
    """A socket for states at a free port of this address, with a large receive buffer."""
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.bind((host, 0))
        try:
            udp.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except PermissionError:
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        udp.setsockopt(socket.SOL_SOCKET, reader.SO_TIMESTAMPNS, 1)
        udp.setsockopt(socket.SOL_SOCKET, reader.SO_RXQ_OVFL, 1)
        time_out = struct.pack("@qq", 0, int(reader.TIME_OUT_S * 1e6))
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, time_out)
    except OSError as error:
        udp.close()
        raise DriverError(f"no UDP socket for the robot's states at {host}: {error}") from error
    return udp


class ReaderClient:
    """Records of a reader process; when it dies, a spare that waits beside it takes over.

    Args:
        udp: from `open_udp`; stays the caller's.
        state_size: bytes of a state.

    Attributes:
        data: memory that the records lie in.
        restarts: readers that had to be replaced.
    """

    def __init__(self, udp: socket.socket, state_size: int) -> None:
        self._udp, self._state_size = udp, state_size
        self._step = reader.slot_size(state_size)
        size = reader.ring_size(state_size)
        self._memory = os.memfd_create("fci-states")
        os.ftruncate(self._memory, size)
        self._map = mmap.mmap(self._memory, size)
        self.data, self._words = memoryview(self._map), words_of(self._map)
        self._event = os.eventfd(0, os.EFD_CLOEXEC)
        self._poll = select.epoll()
        # Edge-triggered: each write of the reader wakes us once, and nothing has to be read.
        self._poll.register(self._event, select.EPOLLIN | select.EPOLLET)
        self._reader: Reader | None = None
        self._spare: Reader | None = None
        self._deaths: deque[float] = deque(maxlen=RESTARTS)
        self._cores = ",".join(map(str, sorted(os.sched_getaffinity(0))))
        self._taken = self._head = self._spare_at = 0
        self._closed = False
        self.restarts = 0

    @property
    def pid(self) -> int:
        """Process id of the reader."""
        assert self._reader is not None
        return self._reader.process.pid

    @property
    def spare_pid(self) -> int | None:
        """Process id of the spare; None for a moment after it took over."""
        return None if self._spare is None else self._spare.process.pid

    def start(self) -> None:
        """Start the reader and wait until it listens. Raises DriverError."""
        first = self._spawn(-1)
        self._work_with(first)
        self._spare = self._spawn(first.alive)
        deadline = time.monotonic() + 10.0  # it needs about 0.05 s
        while not self._words[READY]:
            if self._wait(deadline - time.monotonic()) is not True:
                raise DriverError("the process that reads the robot's states does not start")

    def next(self, wait_s: float) -> Record | None:
        """The next datagram; None where none came within this time. Raises DriverError."""
        self._words[TAIL] = self._taken  # the last one may be written over
        if self._taken == self._head and not self._more(wait_s):
            return None
        start = reader.FIRST_SLOT + self._taken % SLOTS * self._step
        self._taken += 1
        if self._taken == self._spare_at and self._reader and self._spare is None:
            self._spare = self._spawn(self._reader.alive)
        return Record(start + RECORD.size, *RECORD.unpack_from(self._map, start))

    def next_length(self, wait_s: float) -> int | None:
        """Length in bytes of the datagram that `next` will give; None where none comes in time."""
        if self._taken == self._head and not self._more(wait_s):
            return None
        start = reader.FIRST_SLOT + self._taken % SLOTS * self._step
        return RECORD.unpack_from(self._map, start)[2]

    def newest(self) -> int | None:
        """Start of the newest datagram that waits in `data`, of right length; None without."""
        self._head = self._words[HEAD]
        if self._head == self._taken:
            return None
        start = reader.FIRST_SLOT + (self._head - 1) % SLOTS * self._step
        length = RECORD.unpack_from(self._map, start)[2]
        return start + RECORD.size if length == self._state_size else None

    def close(self) -> None:
        """End the reader and free everything; may be called more than once."""
        if self._closed:
            return
        self._closed = True
        for reader_ in (self._spare, self._reader):  # the spare first: it would take over
            if reader_ is not None:
                reader_.end()
        self._poll.close()
        self.data.release()
        self._words.release()
        self._map.close()
        os.close(self._event)
        os.close(self._memory)

    def _more(self, wait_s: float) -> bool:
        """Wait until the head is ahead of us; False where the time is over."""
        deadline = 0.0
        while True:
            self._head = self._words[HEAD]
            if self._head != self._taken:
                return True
            now = time.monotonic()
            deadline = deadline or now + wait_s
            if deadline <= now:
                return False
            woken = self._wait(deadline - now)
            if woken is None:  # where datagrams wait in the socket, the reader does not take them
                woken = not select.select([self._udp], [], [], 0)[0]
            if not woken:
                self._restart()
                deadline = 0.0  # the new one needs its time

    def _wait(self, wait_s: float) -> bool | None:
        """True when the reader woke us, False when it is gone, None after the time."""
        events = self._poll.poll(max(0.0, wait_s), 2)
        if not events:
            return None
        return all(descriptor == self._event for descriptor, _ in events)

    def _spawn(self, before: int) -> Reader:
        """A new reader; it waits until the pipe `before` hangs up, -1 for no waiting."""
        alive, theirs = os.pipe2(os.O_CLOEXEC)
        descriptors = (self._udp.fileno(), self._event, theirs, self._memory)
        arguments = [*descriptors, before, self._state_size, os.getpid()]
        inherited = descriptors if before < 0 else (*descriptors, before)
        command = [sys.executable, "-I", "-S", reader.__file__, *map(str, arguments), self._cores]
        try:
            # A session of its own: a terminal's Ctrl-C must not take the eyes of a safe stop.
            process = subprocess.Popen(
                command, pass_fds=inherited, stdin=subprocess.DEVNULL, start_new_session=True
            )
        except OSError as error:
            os.close(alive)
            raise DriverError(f"cannot start the reader of the robot's states: {error}") from error
        finally:
            os.close(theirs)
        return Reader(process, alive)

    def _work_with(self, reader_: Reader) -> None:
        """Take records from this one from now on, and a little later have a spare for it."""
        self._reader, self._spare = reader_, None
        self._poll.register(reader_.alive, 0)  # hanging up is always told
        self._spare_at = self._taken + 100  # a start takes some of the robot's ticks

    def _restart(self) -> None:
        """The spare reads from the same socket, which kept the datagrams meanwhile."""
        now = time.monotonic()
        if len(self._deaths) == RESTARTS and now - self._deaths[0] < RESTARTS_WITHIN_S:
            raise DriverError(
                f"the process that reads the robot's states died {RESTARTS} times within "
                f"{RESTARTS_WITHIN_S:.0f} s: look at this computer's log for what kills it"
            )
        self._deaths.append(now)
        old, spare = self._reader, self._spare
        if old is not None:
            self._poll.unregister(old.alive)  # the spare holds this pipe as well
            old.end()
        self._reader = self._spare = None
        if spare is not None and spare.process.poll() is not None:  # that died as well
            spare.end()
            spare = None
        self._work_with(self._spawn(-1) if spare is None else spare)
        self.restarts += 1
