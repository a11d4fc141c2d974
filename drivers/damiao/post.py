"""What the loop's process tells its guardian, in memory that both have mapped."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Sequence
from typing import IO

IDLE, DRIVE, HOLD, RELEASED = range(4)
MOST_JOINTS = 15
HEAD_BYTES = 64
ROWS = 4  # held angle, angle, speed, torque
BLOCK_BYTES = HEAD_BYTES + 8 * ROWS * MOST_JOINTS


class Post:
    """The shared block.

    The loop writes, the guardian reads, except for `taken`. Each number is written as a whole;
    numbers of one tick may be mixed with the next one's, which is 1 ms later.

    Args:
        file: of `BLOCK_BYTES`, open for reading and writing.
        joints: of the arm.
    """

    def __init__(self, file: IO[bytes] | int, joints: int) -> None:
        fileno = file if isinstance(file, int) else file.fileno()
        self._map = mmap.mmap(fileno, BLOCK_BYTES)
        self._head = memoryview(self._map)[:HEAD_BYTES].cast("q")
        self._joints = joints
        self._row = struct.Struct(f"{joints}d")
        self._rows = struct.Struct(f"{3 * joints}d")

    @property
    def mode(self) -> int:
        """IDLE: nothing to do; DRIVE: while commands come; HOLD: hold now; RELEASED: go."""
        return self._head[0]

    @mode.setter
    def mode(self, mode: int) -> None:
        self._head[0] = mode

    @property
    def beat_ns(self) -> int:
        """CLOCK_MONOTONIC instant of the last command."""
        return self._head[1]

    @beat_ns.setter
    def beat_ns(self, now_ns: int) -> None:
        self._head[1] = now_ns

    @property
    def taken(self) -> int:
        """How often the guardian has taken a driven arm over."""
        return self._head[2]

    def count_taken(self) -> None:
        """The guardian takes over."""
        self._head[2] += 1

    def put(self, q: Sequence[float], dq: Sequence[float], tau: Sequence[float]) -> None:
        """Where the arm is, rad, how fast, rad/s, and what carries it, N m."""
        self._rows.pack_into(self._map, HEAD_BYTES + self._row.size, *q, *dq, *tau)

    def motion(self) -> tuple[list[float], list[float], list[float]]:
        """(q, dq, tau) as `put` wrote them."""
        values = self._rows.unpack_from(self._map, HEAD_BYTES + self._row.size)
        n = self._joints
        return list(values[:n]), list(values[n : 2 * n]), list(values[2 * n :])

    def hold(self, q: Sequence[float]) -> None:
        """Hold these angles from now on, rad."""
        self._row.pack_into(self._map, HEAD_BYTES, *q)
        self.mode = HOLD

    def held(self) -> list[float]:
        """Angles to hold, rad."""
        return list(self._row.unpack_from(self._map, HEAD_BYTES))

    def close(self) -> None:
        """Unmap; may be called more than once."""
        self._head.release()
        self._map.close()
