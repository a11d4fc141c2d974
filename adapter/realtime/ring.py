"""A ring of fixed-size records between one producer and one consumer, in shared memory.

The producer never waits and takes no lock. `head` counts records ever written and belongs to
the producer; `taken` and `tail` count records ever taken and ever given back and belong to the
consumer. Between the two lies what a consumer has taken but its successor would need again. A
full ring refuses the new record: what was not given back is never overwritten.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from adapter.realtime.shared import SharedBlock, fence, free_bytes
from drivers.interface import JointSample, LinkMotion

# Places in the header; what different processes write lies in different cache lines.
HEAD, TAIL, TAKEN, SKIPPED, FINISHED, ROWS, SIZE = 0, 8, 9, 10, 17, 24, 25
HEADER_WORDS = 32
HEADER_BYTES = 8 * HEADER_WORDS
HAS_LINKS, HAS_COMMAND, HAS_EXTERNAL = 1, 2, 4  # flags of a raw sample


@jit
def put(header, table, record):
    """Copy a record (size,) into the ring; False where it is full."""
    head, rows = header[HEAD], table.shape[0]
    if head - header[TAIL] >= rows:
        return False
    place = head % rows
    for i in range(table.shape[1]):
        table[place, i] = record[i]
    fence()
    header[HEAD] = head + 1
    return True


@jit
def unread_rows(header):
    """How many records wait; what the producer wrote of them is visible after this call."""
    waiting = header[HEAD] - header[TAKEN]
    fence()
    return waiting


@jit
def set_after(header, place, value):
    """Write a header word after everything before it was done."""
    fence()
    header[place] = value


@jit
def read_before(header, place):
    """Read a header word before everything after it is done."""
    value = header[place]
    fence()
    return value


def affordable_rows(sizes: tuple[int, ...], rows: int) -> int:
    """Rows that rings of these record sizes can have in the shared memory that is free."""
    free = free_bytes()
    if free is None or not sizes:
        return rows
    spare = free - len(sizes) * HEADER_BYTES
    return min(rows, max(int(0.9 * spare / (8 * sum(sizes))), 0))


class Ring:
    """See the module. One process pushes, one other process peeks and releases.

    Attributes:
        name: of the shared block, for `attach`.
        size: float64 values in a record.
        rows: capacity.
    """

    def __init__(self, block: SharedBlock, size: int, rows: int) -> None:
        self.name, self.size, self.rows = block.name, size, rows
        self._block = block
        self._header: NDArray[np.int64] = block.array((HEADER_WORDS,), np.int64, 0)
        self._table: Array = block.array((rows, size), np.float64, HEADER_BYTES)

    @classmethod
    def create(cls, size: int, rows: int) -> Ring:
        """An empty ring of `rows` records of `size` float64. Raises SharedMemoryError."""
        if size < 1 or rows < 1:
            raise ValueError(f"a ring needs records and rows of at least 1, got {size}, {rows}")
        ring = cls(SharedBlock.create(HEADER_BYTES + 8 * size * rows), size, rows)
        ring._header[ROWS], ring._header[SIZE] = rows, size
        header = np.zeros(HEADER_WORDS, np.int64)  # kernels are compiled before the clock runs
        put(header, np.zeros((1, size)), np.zeros(size))
        unread_rows(header)
        set_after(header, TAIL, 1)
        return ring

    @classmethod
    def attach(cls, name: str, touch: bool = True) -> Ring:
        """The same ring in a worker process. Raises FileNotFoundError.

        With `touch` every page is brought into this process now and not one by one later.
        """
        block = SharedBlock.attach(name, own=True)
        header = block.array((HEADER_WORDS,), np.int64, 0)
        rows, size = int(header[ROWS]), int(header[SIZE])
        del header
        ring = cls(block, size, rows)
        if touch:
            ring._table[:, 0].sum()
        return ring

    def push(self, record: Array) -> bool:
        """Producer: add a record (size,), C order; False where the ring is full."""
        return bool(put(self._header, self._table, record))

    def finish(self) -> None:
        """Producer: nothing comes any more."""
        set_after(self._header, FINISHED, 1)

    @property
    def finished(self) -> bool:
        """Whether the producer is done; look before `peek` to know that a ring is drained."""
        done = bool(self._header[FINISHED])
        unread_rows(self._header)
        return done

    def peek(self, limit: int | None = None) -> Array:
        """Consumer: the oldest records not taken yet (m, size), as far as they lie in one piece.

        A view of the ring, valid until they are given back.
        """
        waiting = int(unread_rows(self._header))
        start = int(self._header[TAKEN]) % self.rows
        count = min(waiting, self.rows - start)
        if limit is not None:
            count = min(count, limit)
        return self._table[start : start + count]

    def newest(self, count: int) -> Array:
        """Anybody: copy of up to `count` of the newest records (m, size), oldest first.

        A spectator takes nothing and holds nobody up; it gets none where the producer wrote over
        them meanwhile, which takes it all but `count` rows.
        """
        unread_rows(self._header)
        head = self.pushed
        count = max(min(count, head, self.rows - 1), 0)
        found: Array = self._table[np.arange(head - count, head) % self.rows]
        return found[:0] if self.pushed - (head - count) >= self.rows else found

    def take(self, count: int) -> None:
        """Consumer: the next `peek` begins `count` records later; they are kept for a successor."""
        set_after(self._header, TAKEN, self._header[TAKEN] + count)

    def give_back(self) -> None:
        """Consumer: nobody needs again what was taken."""
        set_after(self._header, TAIL, self._header[TAKEN])

    def release(self, count: int) -> None:
        """Consumer: take `count` records and give back all that was taken."""
        self.take(count)
        self.give_back()

    def resume(self, index: int) -> int:
        """Consumer: begin with record number `index`, as the successor of one that died.

        Returns how many records from there on are gone; they are added to `skipped`.
        """
        start = min(max(index, int(self._header[TAIL])), self.pushed)
        gone = max(start - index, 0)
        self._header[SKIPPED] += gone
        set_after(self._header, TAKEN, start)
        return gone

    @property
    def pushed(self) -> int:
        """Records ever written."""
        return int(self._header[HEAD])

    @property
    def released(self) -> int:
        """Records ever given back."""
        return int(self._header[TAIL])

    @property
    def taken(self) -> int:
        """Records ever taken."""
        return int(self._header[TAKEN])

    @property
    def kept(self) -> int:
        """Records taken and not given back."""
        return self.taken - self.released

    @property
    def skipped(self) -> int:
        """Records that no consumer could take because they were gone when one died."""
        return int(self._header[SKIPPED])

    @property
    def unread(self) -> int:
        """Records that wait to be taken."""
        return self.pushed - self.taken

    def close(self) -> None:
        """Let go of the ring in this process; may be called more than once."""
        self._header = self._header.copy()  # the counts stay readable
        self._table = np.zeros((0, self.size))
        self._block.close()

    def unlink(self) -> None:
        """Creator: remove the ring's name."""
        self._block.unlink()


class RawLayout:
    """Where a raw sample and the command given upon it lie in `size` float64.

    Stamp (int64 bits, ns), flags (int64 bits), q, dq, tau, command, external torque (n each), and
    link motion [twist accel] (links, 12) where links > 0.
    """

    def __init__(self, n: int, links: int = 0) -> None:
        self.n, self.links = n, links
        self.size = 2 + 5 * n + 12 * links
        self.q, self.dq, self.tau, self.command, self.external = (
            slice(2 + k * n, 2 + (k + 1) * n) for k in range(5)
        )
        self.motion = slice(2 + 5 * n, self.size)

    def fill(
        self,
        record: Array,
        sample: JointSample,
        command: Array | None,
        external: Array | None = None,
    ) -> None:
        """Write a sample, the torques (n,) commanded upon it and those from outside."""
        flags = 0
        record[self.q], record[self.dq], record[self.tau] = sample.q, sample.dq, sample.tau
        if command is not None:
            record[self.command] = command
            flags |= HAS_COMMAND
        if external is not None:
            record[self.external] = external
            flags |= HAS_EXTERNAL
        if sample.links is not None and self.links:
            motion = record[self.motion].reshape(self.links, 12)
            motion[:, :6], motion[:, 6:] = sample.links.twist, sample.links.accel
            flags |= HAS_LINKS
        words = record[:2].view(np.int64)
        words[0], words[1] = sample.stamp_ns, flags

    def sample(self, record: Array) -> tuple[JointSample, Array | None, Array | None]:
        """Sample, command and external torque of a record, as views; None for what is not there."""
        stamp_ns, flags = (int(word) for word in record[:2].view(np.int64))
        links = None
        if flags & HAS_LINKS:
            motion = record[self.motion].reshape(self.links, 12)
            links = LinkMotion(motion[:, :6], motion[:, 6:])
        command = record[self.command] if flags & HAS_COMMAND else None
        external = record[self.external] if flags & HAS_EXTERNAL else None
        parts = record[self.q], record[self.dq], record[self.tau]
        return JointSample(stamp_ns, *parts, links), command, external
