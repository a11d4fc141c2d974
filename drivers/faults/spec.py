"""Which faults there are, and their text form: `lost=0.01,jump:3@12+0.1,clock@8-3600`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.errors import choices
from drivers.interface import DriverError

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
_ITEM = re.compile(
    rf"(?P<name>[a-z]+)(?::(?P<joint>\d+))?(?P<how>[=@])(?P<value>{_NUMBER})"
    rf"(?P<amount>[+-]{_NUMBER})?"
)


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes:
        says: what happens.
        timed: it begins at a time (`NAME@T`); otherwise it hits a share of samples (`NAME=SHARE`).
        joint: it concerns one joint (`NAME:JOINT@T`), counted from 1.
        amount: how much where nothing is said (`+AMOUNT`); None where there is nothing to say.
        unit: of the amount.
        signed: the amount may be negative.
    """

    says: str
    timed: bool = False
    joint: bool = False
    amount: float | None = None
    unit: str = ""
    signed: bool = False


KINDS: dict[str, Kind] = {
    "lost": Kind("the sample never arrives"),
    "late": Kind("the sample arrives so many samples after newer ones", amount=5, unit="samples"),
    "repeated": Kind("the last sample arrives once more"),
    "reordered": Kind("the sample changes places with the next"),
    "corrupt": Kind("one to three bits of one number are flipped"),
    "stamp": Kind("one to three bits of the stamp are flipped"),
    "nan": Kind("one or all readings of one joint are not a number"),
    "spike": Kind("one reading is far off, by this factor on usual sizes", amount=1.0),
    "slow": Kind("the read takes so much longer", amount=0.005, unit="s"),
    "stuck": Kind("a joint's readings stand still for so long", True, True, 0.5, "s"),
    "jump": Kind("a joint's encoder is off by so much from then on", True, True, 0.1, "rad", True),
    "clock": Kind("all stamps are off by so much from then on", True, False, 3600.0, "s", True),
    "silence": Kind("nothing arrives for so long", True, False, 1.0, "s"),
    "died": Kind("the connection is gone", True),
}


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        name: one of `KINDS`.
        share: of the samples, from 0 to below 1; None where it is timed.
        at_s: when it begins, seconds after the first sample; None where it has a share.
        joint: which, counted from 1; None where it concerns no single one.
        amount: in the kind's unit; None where there is nothing to say.
    """

    name: str
    share: float | None = None
    at_s: float | None = None
    joint: int | None = None
    amount: float | None = None

    def __str__(self) -> str:
        joint = "" if self.joint is None else f":{self.joint}"
        when = f"={self.share!r}" if self.at_s is None else f"@{self.at_s!r}"
        amount = "" if self.amount is None else f"{'' if self.amount < 0 else '+'}{self.amount!r}"
        return f"{self.name}{joint}{when}{amount}"


@dataclass(frozen=True)
class Faults:
    """Faults to inject."""

    items: tuple[Fault, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Faults:
        """Faults of their text form. Raises DriverError, naming the choices.

        Items are separated by commas: `NAME=SHARE` hits that share of all samples,
        `NAME@T` or `NAME:JOINT@T` begins T seconds after the first sample; `+AMOUNT` behind
        either says how much, see `KINDS`.
        """
        items = tuple(_fault(item.strip()) for item in text.split(",") if item.strip())
        shares = [item.name for item in items if item.share is not None]
        for name in shares:
            if shares.count(name) > 1:
                raise DriverError(f"fault '{name}' has two shares; give one")
        return cls(items)

    def __str__(self) -> str:
        return ",".join(map(str, self.items))

    def timed(self, *names: str) -> Sequence[Fault]:
        """Those of these names that begin at a time."""
        return [item for item in self.items if item.at_s is not None and item.name in names]


def _fault(text: str) -> Fault:
    """One item. Raises DriverError."""
    name = re.split(r"[:=@]", text, maxsplit=1)[0]
    if name not in KINDS:
        raise DriverError(f"no fault '{name}'; {choices(name, KINDS)}")
    kind = KINDS[name]
    more = "" if kind.amount is None else f"[+AMOUNT{f' in {kind.unit}' if kind.unit else ''}]"
    when = f"{':JOINT' if kind.joint else ''}{'@SECONDS' if kind.timed else '=SHARE'}"
    usage = f"{name}{when}{more} ({kind.says})"
    found = _ITEM.fullmatch(text)
    if found is None or kind.timed != (found["how"] == "@"):
        raise DriverError(f"fault '{text}' cannot be read; write {usage}")
    if kind.joint != (found["joint"] is not None):
        raise DriverError(f"fault '{text}': write {usage}")
    if kind.amount is None and found["amount"] is not None:
        raise DriverError(f"fault '{text}' takes no amount; write {usage}")
    value = float(found["value"])
    amount = kind.amount if found["amount"] is None else float(found["amount"])
    if not max(value, abs(amount or 0.0)) < float("inf"):
        raise DriverError(f"fault '{text}': a number is too large; write {usage}")
    if amount is not None and amount <= 0.0 and not kind.signed:
        raise DriverError(f"fault '{text}': the amount has to be above zero")
    if kind.timed:
        joint = int(found["joint"]) if kind.joint else None
        return Fault(name, at_s=value, joint=joint, amount=amount)
    if not value < 1.0:
        raise DriverError(f"fault '{text}': the share has to be from 0 to below 1")
    return Fault(name, share=value, amount=amount)
