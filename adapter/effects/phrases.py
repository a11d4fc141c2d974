"""What people call an effect that was found, and experiments that tell effects apart.

Effects may look alike in a recording. Each says what it shows in the experiments that touch it
(`Effect.shows`); in all others it shows what an untouched effect does. Two effects are told apart
by the first experiment of `SPLITS` in which they show different things, so no effect has to know of
the others.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, Protocol


@dataclass(frozen=True)
class Length:
    """The length of a vector of parameters, as people are told it.

    Attributes:
        keys: of its components.
        unit: in which it is shown; factor: from the parameters' unit to that one.
        before: words in front of it in a sentence.
        name: with which it is listed beside the parameters; not listed where empty.
    """

    keys: tuple[str, ...]
    unit: str
    factor: float = 1.0
    before: str = ""
    name: str = ""


@dataclass(frozen=True)
class Phrase:
    """How to say that an effect is there.

    In both sentences {key} is the value of that parameter, {x} the size of the parameter `key`,
    {length} the first of `lengths` that is not zero, {torque} what the effect is worth, {title}
    its title and {who} what it acts on; {lacks}, {has} and {is} agree with {who}.

    Attributes:
        more: the sentence.
        key: the main parameter, whose sign decides between the sentences.
        less: the sentence where that is negative.
        lengths: of vectors of parameters.
    """

    more: str = "{who} {has} {title}"
    key: str = ""
    less: str = ""
    lengths: tuple[Length, ...] = ()

    @classmethod
    def lacks(cls, key: str, what: str) -> Phrase:
        """Of a torque that the model lacks, or has too much of."""
        less = f"{{who}} {{has}} {{x}} less {what} than the model says"
        return cls(f"{{who}} {{lacks}} {{x}} of {what}", key, less)

    @classmethod
    def reads(cls, key: str, sensor: str) -> Phrase:
        """Of a sensor that reads too much, or too little."""
        said = f"the {sensor} of {{who}} reads {{x}} too"
        return cls(f"{said} much", key, f"{said} little")

    @property
    def verb(self) -> str:
        """What several joints do: a model lacks what "{lacks}" says, the rest shows."""
        return "lack" if "{lacks}" in self.more else "show"


@dataclass(frozen=True)
class DecidingExperiment:
    """An experiment.

    Attributes:
        do: what to do.
        untouched: what an effect shows that the experiment does not touch.
    """

    do: str
    untouched: str = "stays"


ALONE = DecidingExperiment("repeat the motion with nothing near the arm")
BARE = DecidingExperiment("take off what the flange carries and repeat the motion")
FLANK = DecidingExperiment(
    "reverse the joint slowly with and without a load that keeps the gear on one flank"
)
LOADS = DecidingExperiment(
    "repeat the motion with a ladder of loads at the flange, at the same speed"
)
WEIGHED = DecidingExperiment(
    "weigh the link apart from the arm, or compute it from its drawing", "does not show"
)
SPEEDS = DecidingExperiment(
    "move the joint at constant speeds from 0.01 to 0.5 rad/s over the same range",
    "is the same at all speeds",
)
STILL = DecidingExperiment(
    "hold the joint still after moving in either direction", "is the same both times"
)
BOTH_WAYS = DecidingExperiment(
    "move the joint at the same speed forwards and backwards", "is as large either way"
)
LATER = DecidingExperiment(
    "repeat the motion after the arm has moved for ten minutes", "is what it was"
)
TURN = DecidingExperiment(
    "move the joint over as much of a turn as it has", "is the same all along"
)
LEVELLED = DecidingExperiment("measure with a level how the base stands", "does not show")
KNOWN_WEIGHT = DecidingExperiment(
    "hang a known weight on the flange and read the torque sensors", "leaves its reading right"
)

TURNS = DecidingExperiment(
    "reverse the joint slowly and follow the torque over the first few mrad", "does not turn over"
)
SWINGS = DecidingExperiment(
    "swing the joint's torque equally far at 1 to 10 Hz", "leaves the torque its size"
)


class Shown(Protocol):
    """What is asked of an effect here."""

    title: ClassVar[str]
    shows: ClassVar[tuple[tuple[DecidingExperiment, str], ...]]


# As they stand above, in the order of preference: what is easy to do and sure comes first.
SPLITS = tuple(x for x in globals().values() if isinstance(x, DecidingExperiment))


def shown(effect: Shown, split: DecidingExperiment) -> str:
    """What an effect shows in an experiment."""
    return dict(effect.shows).get(split, split.untouched)


def experiments(effect: Shown, rivals: Iterable[Shown]) -> tuple[str, ...]:
    """How to tell an effect from its rivals: a sentence for each experiment, the easiest first.

    A rival that no experiment tells from it is not in any.
    """
    by_split: dict[DecidingExperiment, list[Shown]] = {}
    for rival in rivals:
        split = next((s for s in SPLITS if shown(effect, s) != shown(rival, s)), None)
        if split is not None:
            by_split.setdefault(split, []).append(rival)
    return tuple(
        f"{split.do}: " + ", ".join(f"the {e.title} {shown(e, split)}" for e in (effect, *others))
        for split, others in sorted(by_split.items(), key=lambda pair: SPLITS.index(pair[0]))
    )
