"""What the driver and the bridge share: a ring of states, the newest command, who does what.

Each side writes words of its own; each is aligned and written as a whole. The ring's head moves on
when a state is complete. A command is complete when its sequence number is written behind it.
"""

from __future__ import annotations

import mmap
import os
from enum import IntEnum

import numpy as np

from drivers.interface import Array

SLOTS = 1024
HEAD, RECEIVED, STATE = range(3)  # words that the bridge writes
REFUSED = 8  # the first of its counters of refused messages
ASKED, SEQUENCE, BEAT = range(32, 35)  # words that the driver writes
WORDS = 64


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


class Memory:
    """The shared block.

    Args:
        fileno: of a file of `bytes_of(n)`.
        n: joints.
    """

    def __init__(self, fileno: int, n: int) -> None:
        self._map = mmap.mmap(fileno, self.bytes_of(n))
        self.words = np.frombuffer(self._map, np.int64, WORDS)
        self._command = np.frombuffer(self._map, np.float64, n, 8 * WORDS)
        rows = np.frombuffer(self._map, np.float64, SLOTS * (2 + 3 * n), 8 * (WORDS + n))
        self._rows = rows.reshape(SLOTS, 2 + 3 * n)
        self._n = n

    @staticmethod
    def bytes_of(n: int) -> int:
        """Size for n joints."""
        return 8 * (WORDS + n + SLOTS * (2 + 3 * n))

    @classmethod
    def create(cls, n: int) -> tuple[int, Memory]:
        """A new one and its file descriptor, which a child inherits by number."""
        fileno = os.memfd_create("ros2-bridge")
        os.truncate(fileno, cls.bytes_of(n))
        return fileno, cls(fileno, n)

    @property
    def asked(self) -> Asked:
        """What the driver asks."""
        return Asked(int(self.words[ASKED]))

    @property
    def doing(self) -> Doing:
        """What the bridge does."""
        return Doing(int(self.words[STATE]))

    def put_state(self, stamp_ns: int, arrived_ns: int, values: Array) -> None:
        """Bridge: a state (3, n) q, dq, tau."""
        head = int(self.words[HEAD])
        row = self._rows[head % SLOTS]
        row[:2].view(np.int64)[:] = stamp_ns, arrived_ns
        row[2:] = values.reshape(-1)
        self.words[HEAD] = head + 1

    def state(self, index: int) -> tuple[int, int, Array]:
        """Driver: stamp, arrival and a copy (3, n) of the state of this number."""
        row = self._rows[index % SLOTS].copy()
        stamp_ns, arrived_ns = row[:2].view(np.int64).tolist()
        return stamp_ns, arrived_ns, row[2:].reshape(3, self._n)

    def put_command(self, tau: Array, now_ns: int) -> None:
        """Driver: torques (n,)."""
        self._command[:] = tau
        self.words[BEAT] = now_ns
        self.words[SEQUENCE] += 1

    def command(self) -> Array:
        """Bridge: a copy of the torques (n,) asked for last."""
        return self._command.copy()

    def count_refused(self, why: Refusal) -> None:
        """Bridge: one message more that is no sample."""
        self.words[REFUSED + why] += 1
