"""Where the records of a stretch of bytes lie.

Messages come as a `Region`: arrays of places in the bytes of a decompressed chunk, or of the file
itself where it is not chunked, so that numpy can take all messages of a topic at once.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

HEAD = 9  # opcode and length
RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = 22  # channel, sequence, log time, publish time


@dataclass(frozen=True, slots=True)
class Region:
    """Messages that lie in one stretch of bytes.

    Attributes:
        data: the bytes.
        start: (k,) where each payload begins in `data`.
        stop: (k,) where it ends.
    """

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]

    @property
    def channel(self) -> NDArray[np.int64]:
        """(k,) channel numbers."""
        return self.rows(self.start - 22, 2).view("<u2")[:, 0].astype(np.int64)

    @property
    def sequence(self) -> NDArray[np.int64]:
        """(k,) sequence numbers."""
        return self.rows(self.start - 20, 4).view("<u4")[:, 0].astype(np.int64)

    @property
    def times(self) -> NDArray[np.uint64]:
        """(k, 2) log time and publish time, ns."""
        return self.rows(self.start - 16, 16).view("<u8").astype(np.uint64)

    def rows(self, start: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """(k, size) the bytes from each of `start` on."""
        if size == 0 or len(start) == 0:
            return np.empty((len(start), size), np.uint8)
        rows: NDArray[np.uint8] = np.lib.stride_tricks.sliding_window_view(self.data, size)[start]
        return rows


@dataclass
class Walk:
    """What one pass over a stretch of records found; `end` is where it stopped."""

    start: list[int] = field(default_factory=list)
    stop: list[int] = field(default_factory=list)
    others: list[tuple[int, int, int]] = field(default_factory=list)  # opcode, first, last byte
    end: int = 0


def walk(data: memoryview, at: int, until: frozenset[int]) -> Walk:
    """Note all complete records from `at` on; stop before an opcode of `until` or a cut."""
    found = Walk()
    note_start, note_stop, unpack = found.start.append, found.stop.append, RECORD.unpack_from
    message, size = int(Opcode.MESSAGE), len(data)
    while at + HEAD <= size:
        opcode, length = unpack(data, at)
        stop = at + HEAD + length
        if stop > size or opcode in until:
            break
        if opcode != message:
            found.others.append((opcode, at + HEAD, stop))
        elif length < _MESSAGE_HEAD:
            break
        else:
            note_start(at + HEAD + _MESSAGE_HEAD)
            note_stop(stop)
        at = stop
    found.end = at
    return found
