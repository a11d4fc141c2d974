"""What people call an effect that was found."""

from __future__ import annotations

from dataclasses import dataclass


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
