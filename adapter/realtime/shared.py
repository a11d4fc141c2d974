"""Named blocks of memory that several processes see, without leftovers or warnings at exit."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Sequence
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from adapter.errors import MeansError
from adapter.model.spatial import Array
from adapter.physics.kernels import jit

SHM_FOLDER = Path("/dev/shm")
SEQUENCE = 0  # word of a slot that counts publications
WORDS = 8  # of a slot
_TRACKED_ALWAYS = sys.version_info < (3, 13)
_attaching = threading.Lock()


@intrinsic
def _fence(typing_context: Any) -> Any:
    """Memory barrier in compiled code: what is written before is seen before what is after.

    x86 keeps the order of stores by itself, ARM does not, and a compiler may on neither.
    """

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), code


fence: Any = _fence  # compiled code calls it without arguments


class SharedMemoryError(MeansError):
    """A block cannot be created or found; the message says what would do."""


def free_bytes() -> int | None:
    """Shared memory that is free, bytes; None where the system does not say."""
    try:
        state = os.statvfs(SHM_FOLDER)
    except OSError:
        return None
    return max(state.f_bavail * state.f_frsize - (4 << 20), 0)  # left to others


class SharedBlock:
    """One block; its creator unlinks it.

    A block that was created here, or attached with `own=True` by a worker process of the
    creator, is known to the creator's resource tracker, which unlinks it even after a kill -9.
    Attached otherwise, the tracker of this process is kept out: it would unlink a block that
    others still use (Python before 3.13).
    """

    def __init__(self, memory: SharedMemory) -> None:
        self._memory: SharedMemory | None = memory
        self.name = memory.name

    @classmethod
    def create(cls, size: int, name: str | None = None) -> SharedBlock:
        """A block of zeros with all its pages in place.

        Raises:
            SharedMemoryError: not enough shared memory.
            FileExistsError: the name is taken.
        """
        free = free_bytes()
        if free is not None and size > free:
            raise SharedMemoryError(
                f"{size / 2**20:.0f} MB of shared memory are needed, {SHM_FOLDER} has "
                f"{free / 2**20:.0f} MB free; give it more (docker run --shm-size=256m) or use "
                "shorter rings (ring_s)"
            )
        block = cls(SharedMemory(name, create=True, size=size))
        block.array((size,), np.uint8, 0)[:] = 0
        return block

    @classmethod
    def attach(cls, name: str, own: bool = False) -> SharedBlock:
        """An existing block. Raises FileNotFoundError."""
        if own:
            return cls(SharedMemory(name))
        if not _TRACKED_ALWAYS:
            return cls(SharedMemory(name, track=False))  # type: ignore[call-arg,unused-ignore]
        with _attaching:
            register = resource_tracker.register
            resource_tracker.register = lambda *_: None
            try:
                return cls(SharedMemory(name))
            finally:
                resource_tracker.register = register

    @property
    def size(self) -> int:
        """Bytes of the block."""
        return 0 if self._memory is None else self._memory.size

    def array(self, shape: tuple[int, ...], dtype: Any, offset: int) -> NDArray[Any]:
        """A view of the block; must be dropped before `close`."""
        assert self._memory is not None
        return np.ndarray(shape, dtype, self._memory.buf, offset)

    def close(self) -> None:
        """Let go of the block; may be called more than once."""
        memory, self._memory = self._memory, None
        if memory is None:
            return
        try:
            memory.close()
        except BufferError:
            # Someone still holds a view: the mapping goes when the view goes.
            memory.close = lambda: None  # type: ignore[method-assign]

    def unlink(self) -> None:
        """Remove the block's name; processes that are attached keep it. Missing is fine."""
        remove(self.name)


class _Closable(Protocol):
    def close(self) -> None: ...


def leave(orphaned: bool, names: Sequence[str], *parts: _Closable | None) -> None:
    """Let go of memory; remove these names where nobody else is left to do so."""
    for part in parts:
        if part is not None:
            part.close()
    for name in names if orphaned else ():
        remove(name)


def remove(name: str) -> None:
    """Remove a block by its name, if there."""
    try:
        memory = SharedMemory(name)
    except FileNotFoundError:
        return
    try:
        memory.unlink()
    except FileNotFoundError:
        resource_tracker.unregister(f"/{name}", "shared_memory")
    memory.close()


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
    """Numbers in a block that are never read torn: one writer, any number of readers.

    Two slots, each with a sequence number: the writer fills the slot that is not the newest, then
    names it the newest. A reader that was overtaken sees the number change and reads again; a
    writer that dies half-way leaves the other slot whole.

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
