"""Named blocks of memory that several processes see, without leftovers or warnings at exit."""

from __future__ import annotations

import os
import sys
import threading
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

SHM_FOLDER = Path("/dev/shm")
KEEP_FREE = 4 << 20  # bytes of shared memory left to others
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
    return max(state.f_bavail * state.f_frsize - KEEP_FREE, 0)


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
