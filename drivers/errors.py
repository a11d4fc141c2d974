"""What an arm, a bus or a recording refuses to do, and how a name that does not exist is told."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.6  # of difflib's ratio: two letters exchanged, one wrong, one missing


class DriverError(RuntimeError):
    """An arm, bus or recording cannot do what was asked; the message says what can be done."""


class NotReady(DriverError):
    """The arm is there and cannot move yet (reflex, user stop, brakes): no wrong use, no fault."""


class EndOfStream(DriverError):
    """A finite source (a recording) has no further sample."""


def choices(asked: object, have: Iterable[str], more: str = "") -> str:
    """What there is instead of a name that does not exist, and the likeliest of it.

    >>> choices("pnada", ("fr3", "panda"))
    'have: fr3, panda; did you mean panda?'
    >>> choices("ur5", ("fr3", "panda"), " or a .urdf file")
    'have: fr3, panda or a .urdf file'
    """
    names = list(have)
    small = {name.lower(): name for name in names}
    alike = difflib.get_close_matches(str(asked).lower(), small, n=1, cutoff=ALIKE)
    hint = f"; did you mean {small[alike[0]]}?" if alike else ""
    return f"have: {', '.join(names)}{more}{hint}"
