"""What files that others wrote may cost; whatever takes more is refused, with the limit.

A file may be damaged or meant to do harm: it may claim gigabytes in a few bytes, nest without end,
or hold numbers that no computer can compute with.
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHUNK_LIMIT = 2**27  # bytes that one chunk of a recording may make; recorders write up to 2^23
GROWTH_LIMIT = 300  # times its size that a recording may make beside one such chunk; 14 is usual
ARRAYS_LIMIT = 2**29  # bytes that the arrays of an .npz file may make
TEXT_LIMIT = 2**26  # bytes of a text that is read as a whole (models, settings, figures)
DEPTH_LIMIT = 64  # of lists and objects in each other
INTEGER_DIGITS = 19  # what 64 bits hold
_PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_text(path: str | Path, limit: int | None = None) -> str:
    """A text in UTF-8 of at most `limit` bytes (`TEXT_LIMIT`), its line ends as they are.

    Raises:
        OSError, ValueError: it cannot be opened; it is too long, or no such text.
    """
    content = read_bytes(path, limit, " of text")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8 ({error}); save it as UTF-8") from None


def read_bytes(path: str | Path, limit: int | None = None, what: str = "") -> bytes:
    """A file's bytes, at most `limit` (`TEXT_LIMIT`).

    Raises:
        OSError, ValueError: it cannot be opened; it is too long.
    """
    limit = TEXT_LIMIT if limit is None else limit
    with Path(path).open("rb") as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"more than {limit >> 20} MiB{what}")
    return content


def parse_json(text: str | bytes) -> Any:
    """What a JSON text says.

    Raises:
        ValueError: no JSON, lists or objects more than 64 deep in each other, an integer that 64
            bits do not hold, or a number that is none (NaN) or infinite.
    """
    deep = f"lists or objects nested more than {DEPTH_LIMIT} deep"
    try:
        value = json.loads(text, parse_constant=_refused, parse_float=_finite, parse_int=_integer)
    except RecursionError:
        raise ValueError(deep) from None
    level = [value]
    for _ in range(DEPTH_LIMIT + 1):
        level = [part for part in level if isinstance(part, dict | list)]
        if not level:
            return value
        level = [x for part in level for x in (part.values() if isinstance(part, dict) else part)]
    raise ValueError(deep)


def _refused(name: str) -> float:
    raise ValueError(f"'{name}' is not a number; what is unknown is null")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is too large for a number")
    return value


def _integer(text: str) -> int:
    if len(text) > INTEGER_DIGITS:
        raise ValueError(f"an integer of {len(text)} digits; at most {INTEGER_DIGITS} are read")
    return int(text)


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file by key. Raises ValueError; OSError where it cannot be opened."""
    with Path(path).open("rb") as file:
        try:
            with zipfile.ZipFile(file) as whole:
                entries = whole.infolist()
            size = sum(entry.file_size for entry in entries)
            if size > ARRAYS_LIMIT:
                raise ValueError(f"makes {size} bytes; at most {ARRAYS_LIMIT} are read")
            if any(entry.compress_type not in _PLAIN for entry in entries):
                raise ValueError("is compressed in a way that NumPy does not write")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {key: array for key, array in arrays.items() if array.nbytes <= size}
        except (ValueError, OSError):
            raise
        except Exception as error:  # zipfile, zlib and NumPy's header raise kinds of their own
            raise ValueError(str(error) or type(error).__name__) from error
