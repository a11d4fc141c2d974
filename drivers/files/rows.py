"""Rows of numbers that wait in a temporary file, so that a long recording needs no more memory."""

from __future__ import annotations

import tempfile
import weakref

import numpy as np

from drivers.interface import Array

IN_MEMORY = 2**25  # bytes that stay in memory; what is longer goes to the folder TMPDIR names


class RowsFile:
    """A table (m, width) of float64 that grows at its end and is read by stretches.

    The file has no name and is gone with this object, or with the process.

    Args:
        width: numbers per row.
        in_memory: bytes up to which there is no file yet.
    """

    def __init__(self, width: int, in_memory: int = IN_MEMORY) -> None:
        self.width, self._count = width, 0
        self._file = tempfile.SpooledTemporaryFile(max_size=in_memory)  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def __len__(self) -> int:
        return self._count

    def append(self, table: Array) -> None:
        """Put rows (k, width) behind those there are."""
        if table.shape[1:] != (self.width,):
            raise ValueError(f"rows of {self.width} numbers, got {table.shape[1:]}")
        self._file.seek(8 * self.width * self._count)
        self._file.write(np.ascontiguousarray(table, dtype=np.float64).tobytes())
        self._count += len(table)

    def rows(self, start: int, stop: int) -> Array:
        """Rows `start` to `stop` (not included), as far as there are such; a copy, bit by bit."""
        start, stop = min(start, self._count), min(stop, self._count)
        self._file.seek(8 * self.width * start)
        content = bytearray(self._file.read(8 * self.width * max(stop - start, 0)))
        return np.frombuffer(content, dtype=np.float64).reshape(-1, self.width)

    def close(self) -> None:
        """Give the file up."""
        self._file.close()
