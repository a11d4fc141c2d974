"""Numbers and sentences of the report, with their units, for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from adapter.model.numbers import plain, plus_minus
from adapter.model.spatial import Array
from adapter.runs.outcome import SAME_LOAD_S
from adapter.runs.score import POSITION_GOAL_M, ROTATION_GOAL_RAD

NARROW = "\u202f"  # a space that does not break, between a number and its unit
JOIN = "\u2060"  # no break here
GOALS = f"{ROTATION_GOAL_RAD:g}{NARROW}rad and {1e3 * POSITION_GOAL_M:g}{NARROW}mm"
NOT_WATCHED = "not watched for in batches (--every above 1) and where the base floats"

REFUSALS = {
    "non_finite": "a reading was not a finite number",
    "out_of_range": "a reading lay outside what the arm can do",
    "repeated": "identical to the sample before",
    "time_backwards": "its stamp was not after the one before",
    "filter_settling": "the filter was still settling after a start or a gap",
    "at_rest": "the arm was at rest, which teaches nothing",
    "torque_saturated": "a torque was at its limit",
    "implausible_step": "a reading was further from the one before than a joint moves",
    "stuck_joint": "a joint's angle stood still while the arm moved",
    "encoder_jump": "after a joint's angle had jumped nothing more is learned",
    "time_ahead": "its stamp was far ahead of the one before",
    "base_unheard": "nothing was heard of the base's motion",
    "between": "of several within a millisecond, not the one that is used",
}


def number(value: Any, digits: int = 3) -> str:
    """As `plain`, with a true minus; with an exponent where it is tiny.

    >>> number(0.012345), number(1234.5), number(None), number(1e-17)
    ('0.0123', '1235', '–', '0')
    """
    tiny = value is not None and 1e-9 <= abs(float(value)) < 1e-4
    return f"{value:.1e}" if tiny else plain(value, digits).replace("-", "−")


def small(value: float, unit: str) -> str:
    """A size of which less than a thousandth of the unit does not matter."""
    return f"<{NARROW}0.001{NARROW}{unit}" if value < 1e-3 else quantity(value, unit, 2)


def with_doubt(value: Any, std: Any) -> str:
    """`plus_minus` with a true minus.

    >>> with_doubt(-0.2713, 0.0234)
    '−0.271 ± 0.023'
    """
    return plus_minus(value, std).replace("-", "−")


def capital(text: str) -> str:
    """As a sentence begins."""
    return text[:1].upper() + text[1:]


def arrow(before: float, after: float, unit: str) -> str:
    """From a number to another, on one line."""
    return f"{plain(before, 2)} → {plain(after, 2)} {unit}".replace(" ", NARROW)


def count(value: int) -> str:
    """A whole number in groups of three."""
    return f"{int(value):,}".replace(",", NARROW)


def quantity(value: Any, unit: str, digits: int = 3) -> str:
    """A number and its unit, on one line."""
    return f"{number(value, digits)} {unit}".replace(" ", NARROW)


def spread(values: Sequence[float] | Array, unit: str) -> str:
    """Smallest to largest, with the unit, on one line."""
    low, high = number(min(values), 2), number(max(values), 2)
    size = low if low == high else f"{low}{JOIN}–{JOIN}{high}"
    return f"{size} {unit}".replace(" ", NARROW)


def is_live(figures: Mapping[str, Any]) -> bool:
    """Whether a clock was involved, so that deadlines mean something."""
    return bool(figures.get("timing") or figures.get("lateness_us"))


def is_simulated(figures: Mapping[str, Any]) -> bool:
    """Whether the arm was simulated in the process itself, and waited for whoever was late."""
    return ((figures.get("timing") or {}).get("plant_us") or {}).get("p50") is not None


def missed_words(figures: Mapping[str, Any]) -> str:
    """How many deadlines were missed, by our own work and by the machine's."""
    missed = figures.get("missed_deadlines") or 0
    deadlines = count(int(figures["samples"]) + missed)
    if not missed:
        return f"none of {deadlines} deadlines missed"
    said = f"{count(missed)} of {deadlines} deadlines missed"
    timing = figures.get("timing") or {}
    own = timing.get("missed_own")
    if own is None:
        return said
    work = "our own work" + (" and the arm's simulation" if is_simulated(figures) else "")
    return (
        f"{said}: {count(own)} because {work} took too long, {count(missed - own)} because the "
        "machine ran something else"
    )


def not_learned(figures: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Disagreements that the learned model does not hold: a load that it noticed is in it."""
    noticed = [change["stamp_s"] for change in figures["theta"].get("changes") or []]

    def held(report: Mapping[str, Any]) -> bool:
        near = any(abs(at - report["since_s"]) <= SAME_LOAD_S for at in noticed)
        return report["what"] == "payload" and near

    return [report for report in figures.get("disagreements") or [] if not held(report)]
