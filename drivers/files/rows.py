"""Rows of numbers that wait in a temporary file, so that a long recording needs no more memory."""

from __future__ import annotations

import mmap
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

IN_MEMORY = 2**25  # bytes that stay in memory; what is longer goes to the folder TMPDIR names
AT_ONCE = 2**14  # rows that are worked on together


class RowsFile:
    """A table (m, width) of numbers of 8 bytes that grows at its end and is read by stretches.

    The file has no name and is gone with this object and its mapped tables, or with the process.

    Args:
        width: numbers per row.
        in_memory: bytes up to which there is no file yet.
        dtype: float64, or int64.
    """

    def __init__(
        self, width: int, in_memory: int = IN_MEMORY, dtype: DTypeLike = np.float64
    ) -> None:
        self.width, self._count, self._dtype = width, 0, np.dtype(dtype)
        self._file = tempfile.SpooledTemporaryFile(max_size=in_memory)  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def __len__(self) -> int:
        return self._count

    def append(self, table: NDArray[Any]) -> None:
        """Put rows (k, width) behind those there are."""
        if table.shape[1:] != (self.width,):
            raise ValueError(f"rows of {self.width} numbers, got {table.shape[1:]}")
        self._file.seek(8 * self.width * self._count)
        self._file.write(np.ascontiguousarray(table, dtype=self._dtype).data)
        self._count += len(table)

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Rows `start` to `stop` (not included), as far as there are such; a copy, bit by bit."""
        start, stop = min(start, self._count), min(stop, self._count)
        out = np.empty((max(stop - start, 0), self.width), self._dtype)
        self._file.seek(8 * self.width * start)
        self._file.readinto(out.data)
        return out

    def stretches(self) -> Iterator[NDArray[Any]]:
        """All rows, so many at a time."""
        for start in range(0, self._count, AT_ONCE):
            yield self.rows(start, start + AT_ONCE)

    def table(self, mapped: bool) -> NDArray[Any]:
        """All rows (m, width): in memory, or `mapped` into it, read from the file where used."""
        if not (mapped and self._count):
            return self.rows(0, self._count)
        self._file.flush()
        content = mmap.mmap(self._file.fileno(), 8 * self.width * self._count)
        return np.ndarray((self._count, self.width), self._dtype, content)


def is_mapped(table: NDArray[Any]) -> bool:
    """Whether a table is one of `RowsFile.table` that lies in a file, or a part of it."""
    return _mapping(table) is not None


def _mapping(table: NDArray[Any]) -> mmap.mmap | None:
    base = table.base.base if isinstance(table.base, np.ndarray) else table.base
    return base if isinstance(base, mmap.mmap) else None


def copied(table: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
    """Rows of a mapped table in memory; those of the file are let go, which count as memory too."""
    rows, mapping = table[start:stop].copy(), _mapping(table)
    if mapping is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)
    return rows


def stretches(table: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """All rows: at once of a table in memory, of a mapped one so many at a time."""
    if not is_mapped(table):
        yield table
        return
    for start in range(0, len(table), AT_ONCE):
        yield copied(table, start, start + AT_ONCE)


def gathered(width: int, parts: Iterable[NDArray[Any]]) -> RowsFile:
    """A table of rows (k, width) that follow one another."""
    out = RowsFile(width)
    for part in parts:
        out.append(part)
    return out
