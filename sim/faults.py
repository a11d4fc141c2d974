"""Faults of simulated hardware as they are written: NAME[=VALUE][@SECONDS].

From SECONDS on (0 by default) a fault strikes; VALUE says how often, whom or how much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from drivers.errors import choices


class Value(NamedTuple):
    """What may stand for VALUE: in words, and which numbers are that."""

    words: str
    fits: Callable[[float], bool]


NOTHING = Value("", lambda x: False)
NAME = Value("an error's name", lambda x: False)
SHARE = Value("a share from 0 to 1", lambda x: 0.0 <= x <= 1.0)
JOINT = Value("a joint from 1 to 7", lambda x: x in range(1, 8))
SECONDS = Value("seconds", lambda x: x >= 0.0)
COUNT = Value("a count of ticks, not 0", lambda x: x.is_integer() and x != 0)
VERSION = Value("a version from 0 to 65535", lambda x: x.is_integer() and 0 <= x < 1 << 16)


class Kind(NamedTuple):
    """One kind of fault.

    Attributes:
        says: what happens.
        value: what VALUE is.
        usual: VALUE where none is given.
        names: the choices, where VALUE is a name.
        timed: it may begin later.
    """

    says: str
    value: Value = SHARE
    usual: str = "0.01"
    names: tuple[str, ...] = ()
    timed: bool = True


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        name: of its kind.
        value: as its kind has it; 0 where it has none.
        word: VALUE where it is a name.
        at_s: from when on, s.
    """

    name: str
    value: float = 0.0
    word: str = ""
    at_s: float = 0.0


def read_fault(text: str, kinds: Mapping[str, Kind]) -> Fault:
    """The fault that a text names. Raises ValueError, which names the choices."""
    head, at, when = text.strip().partition("@")
    name, equals, value = head.partition("=")
    if name not in kinds:
        raise ValueError(f"no fault {name!r}; {choices(name, kinds)}")
    kind = kinds[name]
    if at and not kind.timed:
        raise ValueError(f"fault {text!r}: {name} has no time")
    at_s = _number(when, text) if at else 0.0
    if at_s < 0.0:
        raise ValueError(f"fault {text!r}: the time has to be 0 s or later")
    if kind.value is NOTHING:
        if equals:
            raise ValueError(f"fault {text!r}: {name} has no value")
        return Fault(name, at_s=at_s)
    value = value if equals else kind.usual
    if kind.value is NAME:
        if value not in kind.names:
            raise ValueError(f"fault {text!r}: no error {value!r}; have: {', '.join(kind.names)}")
        return Fault(name, word=value, at_s=at_s)
    size = _number(value, text)
    if not kind.value.fits(size):
        raise ValueError(f"fault {text!r}: the value of {name} is {kind.value.words}")
    return Fault(name, size, at_s=at_s)


def _number(text: str, whole: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"fault {whole!r}: {text!r} is no number; write NAME[=VALUE][@SECONDS]")
    return number


def describe(kinds: Mapping[str, Kind]) -> str:
    """One line for each kind, for a help text."""
    return "\n".join(
        f"  {name}{'=' + kind.usual if kind.value is not NOTHING else ''}: {kind.says}"
        + (f" ({kind.value.words})" if kind.value.words else "")
        for name, kind in kinds.items()
    )
