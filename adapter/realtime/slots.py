"""Numbers in shared memory that are never read torn: one writer, any number of readers.

Two slots, each with a sequence number: the writer fills the slot that is not the newest, then
names it the newest. A reader that was overtaken sees the number change and reads again; a
writer that dies half-way leaves the other slot whole.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from adapter.model.spatial import Array
from adapter.physics.kernels import jit
from adapter.realtime.shared import SharedBlock, fence

SEQUENCE = 0  # word of a slot that counts publications
WORDS = 8  # of a slot


@jit
def _put(newest, words, values, new_words, new_values):
    """Publish; returns the version."""
    version = newest[0] + 1
    k = version & 1
    words[k, SEQUENCE] = -1
    fence()
    words[k, 1:] = new_words[1:]
    values[k] = new_values
    fence()
    words[k, SEQUENCE] = version
    fence()
    newest[0] = version
    return version


@jit
def _take(newest, words, values, out_words, out_values):
    """Copy the newest slot; False where the writer overtook."""
    version = newest[0]
    fence()
    k = version & 1
    if words[k, SEQUENCE] != version:
        return False
    fence()
    out_words[:] = words[k]
    out_values[:] = values[k]
    fence()
    return words[k, SEQUENCE] == version


class Slots:
    """Two slots of a block.

    Args:
        newest: (1,) word of the block that names the newer slot.
        start: of the slots in the block, bytes.
        size: values of one slot.

    Attributes:
        words, values: (WORDS,), (size,) of this process: filled for `put`, filled by `take`.
    """

    def __init__(
        self, block: SharedBlock, newest: NDArray[np.int64], start: int, size: int
    ) -> None:
        self._newest = newest
        self._words = block.array((2, WORDS), np.int64, start)
        self._values = block.array((2, size), np.float64, start + 16 * WORDS)
        self.words, self.values = np.zeros(WORDS, np.int64), np.zeros(size)

    @staticmethod
    def bytes_of(size: int) -> int:
        """Of both slots."""
        return 16 * (WORDS + size)

    def blank(self) -> None:
        """Nothing is known yet."""
        self._values[:] = np.nan

    def put(self) -> int:
        """Publish `words` and `values`; returns the version."""
        return int(_put(self._newest, self._words, self._values, self.words, self.values))

    def take(self, timeout_s: float) -> bool:
        """Fill `words` and `values`; false where no whole slot could be read in time."""
        deadline = None
        while not _take(self._newest, self._words, self._values, self.words, self.values):
            now = time.monotonic()
            deadline = deadline or now + timeout_s
            if now > deadline:
                return False
        return True


def split(values: Array, shapes: dict[str, tuple[int, ...]]) -> dict[str, Array]:
    """Copies of the parts that follow one another in a slot, by their names."""
    parts, start = {}, 0
    for key, shape in shapes.items():
        size = int(np.prod(shape))
        parts[key] = values[start : start + size].reshape(shape).copy()
        start += size
    return parts
