"""Where things lie in the shared memory of an estimate, and how a slot is filled and read."""

from __future__ import annotations

import json
import os

import numpy as np
from numpy.typing import NDArray

from adapter.fast import jit
from adapter.realtime.shared import SharedBlock, SharedMemoryError, fence

MAGIC = 0x5041534E41503031  # "PASNAP01"
VERSION, KIND, N, BODIES, EFFECTS, PID, TEXT = 0, 8, 9, 10, 11, 12, 13  # words of the header
HEADER_WORDS, TEXT_BYTES = 16, 8192
SEQUENCE, STAMP, LEARNED, PUBLISHED, FLAGS, SOURCE = range(6)  # words of a slot
SLOT_WORDS = 8
LAM_CONVERGED, THETA_CONVERGED = 1, 2


class SnapshotError(RuntimeError):
    """There is no estimate to read or no place to publish one; the message says why."""


@jit
def put(header, words, values, new_words, new_values):
    """Publish; returns the version."""
    version = header[VERSION] + 1
    k = version & 1
    words[k, SEQUENCE] = -1
    fence()
    words[k, 1:] = new_words[1:]
    values[k] = new_values
    fence()
    words[k, SEQUENCE] = version
    fence()
    header[VERSION] = version
    return version


@jit
def take(header, words, values, out_words, out_values):
    """Copy the newest slot; False where the writer overtook."""
    version = header[VERSION]
    fence()
    k = version & 1
    if words[k, SEQUENCE] != version:
        return False
    fence()
    out_words[:] = words[k]
    out_values[:] = values[k]
    fence()
    return words[k, SEQUENCE] == version


class Board:
    """The block's layout, for both sides."""

    def __init__(self, block: SharedBlock) -> None:
        self._block = block
        self.name = block.name
        self._header: NDArray[np.int64] = block.array((HEADER_WORDS,), np.int64, 0)

    def _map(self) -> None:
        head, h = 8 * HEADER_WORDS, self._header
        n, bodies, effects = int(h[N]), int(h[BODIES]), int(h[EFFECTS])
        text = self._block.array((int(h[TEXT]),), np.uint8, head).tobytes()
        names = json.loads(text)
        self.joint_names: tuple[str, ...] = tuple(names["joints"])
        self.effect_names: tuple[str, ...] = tuple(names["effects"])
        self.shapes = {
            "lam": (n, 6),
            "lam_std": (n, 6),
            "theta": (bodies, 10),
            "theta_std": (bodies, 10),
            "effects": (effects, n),
            "effects_std": (effects, n),
        }
        size = value_count(n, bodies, effects)
        start = head + TEXT_BYTES
        self._words = self._block.array((2, SLOT_WORDS), np.int64, start)
        self._values = self._block.array((2, size), np.float64, start + 16 * SLOT_WORDS)
        self._some_words, self._some_values = np.zeros(SLOT_WORDS, np.int64), np.zeros(size)

    def close(self) -> None:
        """Let go of the memory; may be called more than once."""
        self._header = np.zeros(0, np.int64)
        self._words, self._values = np.zeros((0, 0), np.int64), np.zeros((0, 0))
        self._block.close()


def value_count(n: int, bodies: int, effects: int) -> int:
    return 12 * n + 20 * bodies + 2 * effects * n


def allocate(size: int, name: str | None) -> SharedBlock:
    """A block; one that a dead process left under this name is replaced."""
    try:
        return SharedBlock.create(size, name)
    except FileExistsError:
        assert name is not None
    except (SharedMemoryError, OSError) as error:
        raise SnapshotError(f"no shared memory for the estimate: {error}") from error
    old = SharedBlock.attach(name)
    header = old.array((HEADER_WORDS,), np.int64, 0)
    kind, owner = int(header[KIND]), int(header[PID])
    del header
    old.close()
    if kind != MAGIC or _alive(owner):
        who = f"process {owner}" if kind == MAGIC else "another program"
        raise SnapshotError(f"'{name}' is in use by {who}")
    old.unlink()
    return SharedBlock.create(size, name)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return pid > 0
