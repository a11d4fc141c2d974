"""What the driver and the bridge share: a ring of states, the newest command, who does what.

Each side writes words of its own; the ring's head moves on when a state is complete. A command is
complete when its sequence number is written behind it.
"""

from __future__ import annotations

import ctypes
import mmap
from enum import IntEnum

import numpy as np

from drivers.interface import Array
from drivers.process import Block

SLOTS = 1024


class Asked(IntEnum):
    """What the driver asks of the bridge."""

    LISTEN = 0  # send nothing
    DRIVE = 1  # pass commands on; brake when they stay away
    BRAKE = 2  # brake and hold


class Doing(IntEnum):
    """What the bridge does."""

    STARTING = 0
    LISTENING = 1
    DRIVING = 2
    BRAKING = 3
    HOLDING = 4


class Refusal(IntEnum):
    """Why a message is no sample, in the order of its counters."""

    UNREADABLE = 0
    OTHER_JOINTS = 1
    INCOMPLETE = 2
    NOT_FINITE = 3
    JUMP = 4
    OLD = 5
    OVERTAKEN = 6


class Words(Block):
    """What is counted and asked for.

    Attributes:
        head: states ever put into the ring.
        refused: (len(Refusal)) messages, by reason.
        doing: what the bridge does, a `Doing`; the bridge writes it and all before.
        asked: what the driver asks for, an `Asked`; the driver writes it and all that follows.
        sequence: of the newest command; beat_ns: its instant, CLOCK_MONOTONIC.
    """

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("head", "doing")),
        ("refused", ctypes.c_int64 * len(Refusal)),
        ("_apart", ctypes.c_int64 * 8),  # a cache line
        *((name, ctypes.c_int64) for name in ("asked", "sequence", "beat_ns")),
    )


class Memory:
    """The shared block, and its descriptor, which a child inherits by number.

    Args:
        n: joints.
        fileno: of one that is there; None makes one.

    Attributes:
        words: see `Words`.
    """

    def __init__(self, n: int, fileno: int | None = None) -> None:
        more = 8 * (n + SLOTS * (2 + 3 * n))
        if fileno is None:
            fileno, self.words = Words.create(more)
        else:
            self.words = Words.of(fileno)
        self.fileno, self._n = fileno, n
        numbers = np.frombuffer(mmap.mmap(fileno, 0), np.float64, more // 8, ctypes.sizeof(Words))
        self._command, self._rows = numbers[:n], numbers[n:].reshape(SLOTS, 2 + 3 * n)

    def put_state(self, stamp_ns: int, arrived_ns: int, values: Array) -> None:
        """Bridge: a state (3, n) q, dq, tau."""
        row = self._rows[self.words.head % SLOTS]
        row[:2].view(np.int64)[:] = stamp_ns, arrived_ns
        row[2:] = values.reshape(-1)
        self.words.head += 1

    def state(self, index: int) -> tuple[int, int, Array]:
        """Driver: stamp, arrival and a copy (3, n) of the state of this number."""
        row = self._rows[index % SLOTS].copy()
        stamp_ns, arrived_ns = row[:2].view(np.int64).tolist()
        return stamp_ns, arrived_ns, row[2:].reshape(3, self._n)

    def put_command(self, tau: Array, now_ns: int) -> None:
        """Driver: torques (n,)."""
        self._command[:] = tau
        self.words.beat_ns = now_ns
        self.words.sequence += 1

    def command(self) -> Array:
        """Bridge: a copy of the torques (n,) asked for last."""
        return self._command.copy()
