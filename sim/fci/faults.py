"""Faults that can be switched on, as they are written: NAME[=VALUE][@SECONDS]."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim.fci.layout import ERRORS, JOINTS

RATE, JOINT, ONCE, WORDS = "a share from 0 to 1", "a joint from 1 to 7", "", "an error's name"
SECONDS, COUNT, NUMBER = "seconds", "a count of ticks, not 0", "a version from 0 to 65535"
# Name -> what its value is, the value where none is given, what happens.
KINDS: dict[str, tuple[str, str, str]] = {
    "drop": (RATE, "0.01", "states are lost"),
    "drop_commands": (RATE, "0.01", "commands are lost"),
    "late": (RATE, "0.01", "states arrive 1 to 5 ms later"),
    "repeat": (RATE, "0.01", "states arrive twice"),
    "reorder": (RATE, "0.01", "states arrive after their successor"),
    "corrupt": (RATE, "0.01", "states arrive with some bytes changed, or cut short"),
    "nan": (RATE, "0.01", "a joint's q, dq or torque is not a number"),
    "spike": (RATE, "0.01", "a joint's q, dq or torque is far off for a tick"),
    "stuck": (JOINT, "3", "a joint's q stays what it was"),
    "jump": (JOINT, "3", "a joint's q is 0.05 rad more from then on"),
    "reflex": (WORDS, "cartesian_reflex", "the robot trips with this error"),
    "user_stop": (SECONDS, "1", "somebody presses the user stop for so long"),
    "cut": (ONCE, "", "the connection is closed"),
    "silence": (SECONDS, "1000000", "nothing is sent for so long"),
    "clock": (COUNT, "10000", "message ids jump by so many"),
    "version": (NUMBER, "7", "the server says that it speaks this version"),
}
AT_ONCE = ("version",)  # these have no time


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        name: one of `KINDS`.
        value: share, joint (1 to 7), seconds, ticks or version; 0 where it has none.
        word: the error's name, of `reflex`.
        at_s: from when on, seconds of the simulated world (which stands while no client is there).
    """

    name: str
    value: float = 0.0
    word: str = ""
    at_s: float = 0.0

    @classmethod
    def of(cls, text: str) -> Fault:
        """Read NAME[=VALUE][@SECONDS]. Raises ValueError, which names the choices."""
        head, at, when = text.partition("@")
        name, equals, value = head.partition("=")
        if name not in KINDS:
            raise ValueError(f"no fault {name!r}; have: {', '.join(KINDS)}")
        kind, usual, _ = KINDS[name]
        if at and name in AT_ONCE:
            raise ValueError(f"fault {text!r}: {name} has no time")
        at_s = _number(when, text) if at else 0.0
        if at_s < 0.0:
            raise ValueError(f"fault {text!r}: the time has to be 0 s or later")
        if kind == ONCE and equals:
            raise ValueError(f"fault {text!r}: {name} has no value")
        value = value if equals else usual
        if kind == WORDS:
            if value not in ERRORS:
                raise ValueError(f"fault {text!r}: no error {value!r}; have: {', '.join(ERRORS)}")
            return cls(name, 0.0, value, at_s)
        size = 0.0 if kind == ONCE else _number(value, text)
        if not _fits(kind, size):
            raise ValueError(f"fault {text!r}: the value of {name} is {kind}")
        return cls(name, size, "", at_s)


def _fits(kind: str, size: float) -> bool:
    if kind == RATE:
        return 0.0 <= size <= 1.0
    if kind == JOINT:
        return size.is_integer() and 1 <= size <= JOINTS
    if kind == COUNT:
        return size.is_integer() and size != 0
    if kind == NUMBER:
        return size.is_integer() and 0 <= size < 1 << 16
    return size >= 0.0


def _number(text: str, whole: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"fault {whole!r}: {text!r} is no number; write NAME[=VALUE][@SECONDS]")
    return number


def describe() -> str:
    """One line for each fault, for a help text."""
    return "\n".join(
        f"  {name}{'=' + usual if usual else ''}: {what}" + (f" ({kind})" if kind else "")
        for name, (kind, usual, what) in KINDS.items()
    )
