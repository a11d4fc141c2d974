"""Number files as other tools write them: CSV, white space, one value a line, npz, Parquet.

Texts may be packed by gzip. A data set of LeRobot is a folder: `meta/info.json` names its joints,
`data/` holds Parquet files in which a column of lists is a signal.
"""

from __future__ import annotations

import codecs
import csv
import fnmatch
import gzip
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter import optional
from drivers.files.bounded import ARRAYS_LIMIT, parse_json, read_arrays, read_text
from drivers.interface import Array, DriverError

_SEPARATORS = (";", "\t", "|", ",")
_UTF16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
# of a header: pos [deg] or time_ms, not q[0]
_UNIT = re.compile(r"\s*[\[(]\s*([^\d\])][^\])]*)[\])]\s*$|_(ms|us|ns|deg|rad|mm|mNm|Nm)$")


@dataclass(frozen=True, slots=True)
class SourceTable:
    """Columns (m, k) of one file and their names, () where the file has no header.

    `lines` has the line of each row, () where the file has none; `units` what the header says of
    each column's, "" where nothing; `words` row and text of a cell of each column that is no
    number throughout, whose value is not a number.
    """

    path: Path
    names: tuple[str, ...]
    values: Array
    lines: tuple[int, ...] = ()
    units: tuple[str, ...] = ()
    words: Mapping[int, tuple[int, str]] = field(default_factory=dict)

    def place(self, row: int) -> str:
        """Where a row stands in the file."""
        return f"line {self.lines[row]}" if self.lines else f"row {row}"

    def places(self, selectors: Sequence[str], what: str) -> list[int]:
        """Places of the columns that selectors name, in their order.

        A selector is a place (`3`, counted from 0), a half-open range of places (`2:9`, `2:`), a
        name of the header, with its unit or without, or a pattern of names (`q_*`).

        Raises:
            DriverError: a selector finds no column; `what` says what it was for.
        """
        return [i for selector in selectors for i in self._places(selector, what)]

    def numbers(self, places: Sequence[int], blanks: bool = False) -> Array:
        """The columns at these places. Raises DriverError: a cell is no number, or blank."""
        for place in places:
            row, word = self.words.get(place, (0, ""))
            if place in self.words and (word or not blanks):
                named = f" ({self.names[place]})" if self.names else ""
                at = f"{self.path}: {self.place(row)}, column {place}{named}"
                raise DriverError(f"{at}: '{word}' is not a number")
        return self.values[:, list(places)]

    def is_text(self, place: int) -> bool:
        """Whether no cell of a column is a number."""
        return place in self.words and not np.isfinite(self.values[:, place]).any()

    def _places(self, selector: str, what: str) -> list[int]:
        count = self.values.shape[1]
        if re.fullmatch(r"\d+", selector):
            first, last = int(selector), int(selector) + 1
        elif match := re.fullmatch(r"(\d*):(\d*)", selector):
            first, last = int(match[1] or 0), int(match[2] or count)
        else:
            places = self.found(selector)
            if not places:
                having = self._having() or f"; it has no header, name columns 0 to {len(self) - 1}"
                raise DriverError(f"{self.path}: no column '{selector}' for {what}{having}")
            return places
        if not first < last <= count:
            has = f"it has {count} columns, 0 to {count - 1}{self._having()}"
            raise DriverError(f"{self.path}: column {selector} for {what} isn't there; {has}")
        return list(range(first, last))

    def found(self, selector: str) -> list[int]:
        """Places of the columns of that name, else of that list, else of that pattern."""
        ways: tuple[Callable[[str, str], bool], ...] = (
            str.__eq__,
            lambda name, x: _UNIT.sub("", name) == x,
            lambda name, x: name.startswith(f"{x}["),
            fnmatch.fnmatchcase,
        )
        places = ([i for i, x in enumerate(self.names) if fits(x, selector)] for fits in ways)
        return next(filter(None, places), [])

    def __len__(self) -> int:
        return int(self.values.shape[1])

    def _having(self) -> str:
        return f"; named {', '.join(self.names)}" if self.names else ""


def read_table(path: Path) -> SourceTable:
    """A text table; separator and header are found out, `#` lines are comments.

    The separator is `;`, a tab, `|`, `,` or white space: the first that leaves most numbers in a
    line. Commas that separate nothing are decimal. A first line with anything but numbers is the
    header, unless the numbers stand where those of the other lines do; a comment right before the
    numbers is, if it has as many words as they have columns. A line below the header without any
    number tells units; so do brackets in the header. A cell may hold a list, `[0.1, 0.2]`: its
    column becomes as many, `name[0]`, `name[1]`, ...

    Raises:
        DriverError: unreadable or empty, or without numbers, or a line has another number of
            values; names file and line.
    """
    lines = _lines(path)
    comments = [text for _, text in lines if text.startswith("#")]
    lines = [(number, text) for number, text in lines if not text.startswith("#")]
    if not lines:
        raise DriverError(f"{path}: holds no numbers")
    line, usual = lines[min(2, len(lines) - 1)]
    separator = _separator(usual, lines[0][1])
    if len(lines) > 1 and not any(_numeric(usual, separator)):
        word = _split(usual, separator)[0]
        raise DriverError(f"{path}: line {line}: '{word}' is not a number")
    names: list[str] = []
    words, numeric = _split(lines[0][1], separator), _numeric(lines[0][1], separator)
    if not all(numeric) and not (any(numeric) and numeric == _numeric(usual, separator)):
        names, lines = words, lines[1:]
    elif comments and len(_split(comments[-1].lstrip("# "), separator)) == len(words):
        names = _split(comments[-1].lstrip("# "), separator)
    if not lines:
        raise DriverError(f"{path}: holds a header ({', '.join(names)}) and no numbers")
    units = [(x[1] or x[2]).strip() if (x := _UNIT.search(name)) else "" for name in names]
    if names and len(lines) > 1 and not any(_numeric(lines[0][1], separator)):
        below = [word.strip("[]() ") for word in _split(lines.pop(0)[1], separator)]
        units = below if len(below) == len(names) else units
    if names and len(names) != (count := len(_split(lines[0][1], separator))):
        raise DriverError(
            f"{path}: the header names {len(names)} columns, line {lines[0][0]} has {count} values"
        )
    texts = [text if separator == "," else text.replace(",", ".") for _, text in lines]
    numbers = tuple(number for number, _ in lines)
    try:
        values = np.loadtxt(texts, delimiter=separator, ndmin=2, comments=None, quotechar='"')
    except ValueError:
        return _mixed(
            SourceTable(path, tuple(names), np.empty(0), numbers, tuple(units)), lines, separator
        )
    return SourceTable(path, tuple(names), values, numbers, tuple(units))


def _mixed(like: SourceTable, lines: list[tuple[int, str]], separator: str | None) -> SourceTable:
    """A table in which cells hold lists, texts or nothing. Raises DriverError."""
    path, (first, text) = like.path, lines[0]
    sizes = [len(_listed(cell) or [cell]) for cell in _split(text, separator)]
    values = np.full((len(lines), sum(sizes)), np.nan)
    odd: dict[int, tuple[int, str]] = {}
    for row, (number, text) in enumerate(lines):
        words: list[str] = []
        for k, cell in enumerate(_split(text, separator)):
            blank = [cell] * (sizes[k] if not cell and k < len(sizes) else 1)
            words += _listed(cell) or [_point(word, separator) for word in blank]
        if len(words) != values.shape[1]:
            raise DriverError(
                f"{path}: line {number} has {len(words)} values, line {first} has {values.shape[1]}"
            )
        for place, word in enumerate(words):
            if _is_number(word):
                values[row, place] = float(word)
            elif place not in odd or (word and not odd[place][1]):  # a text, before any blank
                odd[place] = row, word
    names, units = list[str](), list[str]()
    for name, unit, size in zip(like.names, like.units, sizes, strict=False):
        bare = _UNIT.sub("", name)
        names += [f"{bare}[{k}]" for k in range(size)] if size > 1 else [name]
        units += [unit] * size
    return replace(like, names=tuple(names), values=values, units=tuple(units), words=odd)


def _separator(data: str, first: str) -> str | None:
    """What separates the numbers of a line of data; where none does, those of the first line."""

    def numbers(separator: str | None) -> tuple[bool, int]:
        found = _numeric(data, separator) if separator is None or separator in data else [False]
        return all(found), sum(found)

    best = max((*_SEPARATORS, None), key=numbers)
    return best if any(numbers(best)) else next((s for s in _SEPARATORS if s in first), None)


def read_parquet(path: Path, episode: int | None = None) -> SourceTable:
    """The number columns of a Parquet file, or of one episode of a LeRobot data set (a folder).

    A column of lists of k numbers becomes k columns, `name[0]` to `name[k - 1]`.

    Raises:
        DriverError: unreadable, no numbers, or several episodes and none chosen; says what it has.
    """
    parquet = optional.load("pyarrow.parquet")
    files = sorted((path / "data").rglob("*.parquet")) if path.is_dir() else [path]
    if not files:
        raise DriverError(f"{path}: has no Parquet file in data/; is it a LeRobot data set?")
    if episode is not None and path.is_dir():
        files = [f for f in files if f.stem == f"episode_{episode:06d}"] or files
    parts = []
    for file in files:
        try:
            parts.append(_columns(parquet.ParquetFile(file), file))
        except (OSError, ValueError, MemoryError) as error:  # pyarrow's own are ValueErrors
            raise DriverError(f"{file}: cannot be read as Parquet: {error}") from error
    if any(part.keys() != parts[0].keys() for part in parts):
        raise DriverError(f"{path}: its files have different columns")
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not whole or not len(next(iter(whole.values()))):
        raise DriverError(f"{path}: holds no numbers")
    rows = _of_episode(path, whole, episode)
    return SourceTable(path, tuple(whole), np.column_stack([x[rows] for x in whole.values()]))


def _columns(file: Any, path: Path) -> dict[str, Array]:
    """Numbers and lists of numbers, all of one length."""
    size = sum(file.metadata.row_group(i).total_byte_size for i in range(file.num_row_groups))
    if size > ARRAYS_LIMIT:
        raise DriverError(f"{path}: makes {size} bytes; at most {ARRAYS_LIMIT} are read")
    found: dict[str, Array] = {}
    for name, column in zip(file.schema_arrow.names, file.read().columns, strict=True):
        values = np.asarray(column.to_numpy())
        if values.dtype.kind == "O" and len(values) and isinstance(values[0], np.ndarray):
            lengths = {np.shape(x) for x in values}
            if len(lengths) == 1 and len(values[0].shape) == 1 and values[0].dtype.kind in "fiu":
                table = np.stack(list(values)).astype(np.float64)
                found |= {f"{name}[{k}]": table[:, k] for k in range(table.shape[1])}
        elif values.dtype.kind in "fiu":
            found[name] = values.astype(np.float64)
    return found


def _of_episode(path: Path, columns: dict[str, Array], episode: int | None) -> Any:
    told = columns.get("episode_index")
    if told is None:
        return slice(None)
    have = np.unique(told).astype(int).tolist()
    if episode is None and len(have) > 1:
        raise DriverError(
            f"{path}: has {len(have)} episodes, {have[0]} to {have[-1]}; choose one (--episode N)"
        )
    if episode is not None and episode not in have:
        raise DriverError(f"{path}: has no episode {episode}; have {have[0]} to {have[-1]}")
    return slice(None) if episode is None else told == episode


def lerobot_joints(path: Path) -> tuple[str, ...]:
    """Names of the joints that a LeRobot data set tells, () where it tells none."""
    info = path / "meta" / "info.json"
    if not info.is_file():
        return ()
    try:
        names = parse_json(read_text(info))["features"]["observation.state"]["names"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DriverError(f"{info}: does not describe observation.state: {error}") from error
    names = names.get("motors", ()) if isinstance(names, dict) else names
    whole = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return tuple(name.removesuffix(".pos") for name in names) if whole else ()


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
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            source = gzip.GzipFile(fileobj=file) if packed else file
            raw = source.read(ARRAYS_LIMIT + 1)
        if len(raw) > ARRAYS_LIMIT:
            raise DriverError(f"{path}: makes more than {ARRAYS_LIMIT >> 20} MiB of text")
        content = raw.decode("utf-16" if raw.startswith(_UTF16) else "utf-8-sig")
    except (OSError, EOFError, zlib.error) as error:
        said = getattr(error, "strerror", None) or error
        raise DriverError(f"{path}: cannot be read: {said}") from error
    except UnicodeDecodeError as error:
        if any(byte < ord(" ") and byte not in b"\t\r\n\f" for byte in raw):
            raise DriverError(f"{path}: is neither text nor .npz") from error
        content = raw.decode("latin-1")  # of a spreadsheet: a degree sign
    stripped = ((i, line.strip()) for i, line in enumerate(content.splitlines(), 1))
    return [(i, line) for i, line in stripped if line]


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    try:
        return [word.strip() for word in next(csv.reader([line], delimiter=separator))]
    except csv.Error:  # a field longer than any number
        return [line]


def _numeric(line: str, separator: str | None) -> list[bool]:
    """Which cells of a line are numbers or lists of them."""
    cells = ((cell, _listed(cell)) for cell in _split(line, separator))
    return [all(map(_is_number, listed or [_point(cell, separator)])) for cell, listed in cells]


def _listed(cell: str) -> list[str]:
    """What a list in a cell holds, with commas between or white space."""
    if not (cell.startswith("[") and cell.endswith("]")):
        return []
    return cell[1:-1].replace(",", " ").split()


def _point(cell: str, separator: str | None) -> str:
    return cell if separator == "," else cell.replace(",", ".")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
