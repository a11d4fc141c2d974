"""How a command ends, as a number for scripts; every code of every command stands here."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum


class ExitCode(IntEnum):
    """Codes of `adapter`; `words` say when."""

    words: str

    def __new__(cls, value: int, words: str) -> ExitCode:
        """A code with its words."""
        code = int.__new__(cls, value)
        code._value_, code.words = value, words
        return code

    DONE = 0, "done"
    WRONG_USE = 2, "wrong use, or a file or address that cannot be used"
    ARM_FAILED = 3, "the arm failed, or its driver stopped it"
    LEARNER_FAILED = 4, "the learner failed"
    NO_MEANS = 5, "the machine lacks the means"
    NOT_READY = 6, "the robot is not ready; the error says what to do"
    INCOMPLETE = 7, "samples are missing in the recording, all else is done"
    NOTHING_LEARNED = 8, "no sample taught anything, or the torques are not those of the arm"
    NOT_CONVERGED = 9, "there are results, but θ (what the links weigh) had not converged"
    INTERRUPTED = 130, "interrupted before there were results"


ALWAYS = (ExitCode.DONE, ExitCode.WRONG_USE, ExitCode.NO_MEANS, ExitCode.INTERRUPTED)


def listed(more: Iterable[ExitCode] = ()) -> str:
    """The codes that every command has and these, for `--help`."""
    codes = sorted({*ALWAYS, *more})
    return "Exit codes: " + "; ".join(f"{code.value} {code.words}" for code in codes) + "."
