"""Number files as other tools write them: CSV, white space, one value a line, npz."""

from __future__ import annotations

import csv
import fnmatch
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.files.bounded import read_arrays
from drivers.interface import Array, DriverError

_INDEX = re.compile(r"\d+")
_RANGE = re.compile(r"(\d*):(\d*)")


@dataclass(frozen=True, slots=True)
class SourceTable:
    """Columns (m, k) of one file and their names, () where the file has no header."""

    path: Path
    names: tuple[str, ...]
    values: Array

    def columns(self, selectors: Sequence[str], what: str) -> Array:
        """The columns that selectors name, in their order.

        A selector is a place (`3`, counted from 0), a half-open range of places (`2:9`, `2:`), a
        name of the header, or a pattern of names (`q_*`).

        Raises:
            DriverError: a selector finds no column; `what` says what it was for.
        """
        places = [i for selector in selectors for i in self._places(selector, what)]
        return self.values[:, places]

    def _places(self, selector: str, what: str) -> list[int]:
        count = self.values.shape[1]
        if _INDEX.fullmatch(selector):
            first, last = int(selector), int(selector) + 1
        elif match := _RANGE.fullmatch(selector):
            first, last = int(match[1] or 0), int(match[2] or count)
        else:
            return self._named(selector, what)
        if not first < last <= count:
            raise DriverError(
                f"{self.path}: column {selector} for {what} isn't there; it has {count} columns, "
                f"0 to {count - 1}{self._having()}"
            )
        return list(range(first, last))

    def _named(self, selector: str, what: str) -> list[int]:
        places = [i for i, name in enumerate(self.names) if name == selector]
        places = places or [
            i for i, name in enumerate(self.names) if fnmatch.fnmatchcase(name, selector)
        ]
        if not places:
            having = self._having() or f"; it has no header, name columns 0 to {len(self) - 1}"
            raise DriverError(f"{self.path}: no column '{selector}' for {what}{having}")
        return places

    def __len__(self) -> int:
        return int(self.values.shape[1])

    def has(self, selector: str) -> bool:
        """Whether a name or pattern finds a column."""
        return any(fnmatch.fnmatchcase(name, selector) for name in self.names)

    def _having(self) -> str:
        return f"; named {', '.join(self.names)}" if self.names else ""


def read_table(path: Path) -> SourceTable:
    """A text table; separator and header are found out, `#` lines are comments.

    The separator is `;` (then with decimal commas, if there are commas), `,` or white space. A
    first line with anything but numbers is the header; a comment right before the numbers is, if
    it has as many words as they have columns.

    Raises:
        DriverError: unreadable or empty, or a line has another number of values or no number;
            names file, line and column.
    """
    lines = _lines(path)
    comments = [text for _, text in lines if text.startswith("#")]
    lines = [(number, text) for number, text in lines if not text.startswith("#")]
    if not lines:
        raise DriverError(f"{path}: holds no numbers")
    separator = next((s for s in (";", ",") if s in lines[0][1]), None)
    names: list[str] = []
    words = _split(lines[0][1], separator)
    if not all(map(_is_number, _decimal_points(words, separator))):
        names, lines = words, lines[1:]
    elif comments and len(_split(comments[-1].lstrip("# "), separator)) == len(words):
        names = _split(comments[-1].lstrip("# "), separator)
    if not lines:
        raise DriverError(f"{path}: holds a header ({', '.join(names)}) and no numbers")
    texts = [text for _, text in lines]
    if separator == ";":
        texts = [text.replace(",", ".") for text in texts]
    try:
        values = np.loadtxt(texts, delimiter=separator, ndmin=2, comments=None)
    except ValueError as error:
        raise DriverError(_blame(path, lines, separator, names)) from error
    if names and len(names) != values.shape[1]:
        raise DriverError(
            f"{path}: the header names {len(names)} columns, line {lines[0][0]} has "
            f"{values.shape[1]} values"
        )
    return SourceTable(path, tuple(names), values)


def read_npz(path: Path) -> dict[str, Array]:
    """The number arrays of an npz file by key. Raises DriverError."""
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError) as error:
        raise DriverError(f"{path}: cannot be read as .npz: {error}") from error
    return {key: x.astype(np.float64) for key, x in arrays.items() if x.dtype.kind in "fiu"}


def _lines(path: Path) -> list[tuple[int, str]]:
    """Line numbers from 1 and stripped lines, without empty ones."""
    try:
        content = path.read_text("utf-8-sig")
    except OSError as error:
        raise DriverError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DriverError(f"{path}: is neither text nor .npz") from error
    stripped = ((i, line.strip()) for i, line in enumerate(content.splitlines(), 1))
    return [(i, line) for i, line in stripped if line]


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    return [word.strip() for word in next(csv.reader([line], delimiter=separator))]


def _decimal_points(words: list[str], separator: str | None) -> list[str]:
    return [w.replace(",", ".") for w in words] if separator == ";" else words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _blame(
    path: Path, lines: list[tuple[int, str]], separator: str | None, names: list[str]
) -> str:
    """The first line that keeps a table from being one."""
    first, expected = lines[0][0], len(_split(lines[0][1], separator))
    for number, text in lines:
        words = _decimal_points(_split(text, separator), separator)
        for column, word in enumerate(words):
            if not _is_number(word):
                named = f" ({names[column]})" if column < len(names) else ""
                return f"{path}: line {number}, column {column}{named}: '{word}' is not a number"
        if len(words) != expected:
            return f"{path}: line {number} has {len(words)} values, line {first} has {expected}"
    return f"{path}: is not a table of numbers"
