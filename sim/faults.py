"""Faults of simulated hardware: how they are written, when they strike, what a network does.

They are written NAME[=VALUE][@SECONDS]: from SECONDS on (0 by default) a fault strikes; VALUE says
how often, whom or how much.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from drivers.errors import choices

M = TypeVar("M")


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


class Faults:
    """Faults of one simulated device, drawn by seed; counts what struck.

    Args:
        texts: of the faults.
        kinds: that there are.
        seed: of all that is random.

    Attributes:
        faults: as they were asked for.
        counts: how often each fault struck.

    Raises:
        ValueError: no such fault, or one that cannot be; names the choices.
    """

    def __init__(
        self, texts: Iterable[str], kinds: Mapping[str, Kind], seed: Sequence[int]
    ) -> None:
        self.faults = tuple(read_fault(text, kinds) for text in texts)
        self.counts: Counter[str] = Counter()
        self._always = {name for name, kind in kinds.items() if kind.value is NOTHING}
        self._rng = np.random.default_rng(seed)
        self._due = list(self.faults)

    def __bool__(self) -> bool:
        return bool(self.faults)

    def acting(self, name: str, now_s: float) -> Iterator[Fault]:
        """The faults of this name whose time has come."""
        return (fault for fault in self.faults if fault.name == name and now_s >= fault.at_s)

    def strikes(self, name: str, now_s: float) -> bool:
        """Whether a fault that hits a share, or without a value all, hits now."""
        for fault in self.acting(name, now_s):
            if name in self._always or self._rng.random() < fault.value:
                self.counts[name] += 1
                return True
        return False

    def hits(self, name: str, number: int, now_s: float) -> bool:
        """Whether a joint or motor (from 1) has a fault."""
        found = any(fault.value == number for fault in self.acting(name, now_s))
        self.counts[name] += found
        return found

    def within(self, name: str, now_s: float) -> bool:
        """Whether a fault that lasts VALUE seconds lasts."""
        return any(now_s < fault.at_s + fault.value for fault in self.acting(name, now_s))

    def once(self, names: Sequence[str], now_s: float) -> list[Fault]:
        """The faults of these names whose time has come since the last call."""
        due = [fault for fault in self._due if fault.name in names and now_s >= fault.at_s]
        for fault in due:
            self._due.remove(fault)
            self.counts[fault.name] += 1
        return due

    def pick(self, below: int) -> int:
        """A number from 0 to below - 1."""
        return int(self._rng.integers(below))


class Network(Generic[M]):
    """What becomes of messages on their way: lost, damaged, late, twice, or behind the next one.

    Args:
        faults: `drop`, `corrupt`, `late`, `repeat` and `reorder` of them strike.
        late: by how much a message is late, drawn anew for each, on whatever clock is told.
        damaged: a message as it arrives damaged.
    """

    def __init__(self, faults: Faults, late: Callable[[], int], damaged: Callable[[M], M]) -> None:
        self._strikes, self._late, self._damaged = faults.strikes, late, damaged
        self._later: list[tuple[int, int, M]] = []
        self._behind: list[M] = []
        self._count = 0

    def passed(self, message: M, now_s: float, clock: int) -> list[M]:
        """What arrives at once where this is sent; `now_s` is the time that faults go by."""
        if self._strikes("drop", now_s):
            return []
        if self._strikes("corrupt", now_s):
            message = self._damaged(message)
        if self._strikes("late", now_s):
            self._count += 1
            heapq.heappush(self._later, (clock + self._late(), self._count, message))
            return []
        if self._strikes("reorder", now_s):
            self._behind.append(message)
            return []
        behind, self._behind = self._behind, []
        return [message] * (1 + self._strikes("repeat", now_s)) + behind

    def due(self, clock: int) -> list[M]:
        """What was late and arrives by now."""
        found = []
        while self._later and self._later[0][0] <= clock:
            found.append(heapq.heappop(self._later)[2])
        return found

    def next_due(self) -> int | None:
        """When the next late message arrives."""
        return self._later[0][0] if self._later else None

    def forget(self) -> None:
        """The connection is gone, and with it whatever was under way."""
        self._later, self._behind = [], []
