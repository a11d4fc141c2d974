"""Numbers and sentences of the report, with their units, for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from adapter.model.self_model import LAMBDA_DOCUMENTATION as DOCUMENTATION
from adapter.model.self_model import LAMBDA_MEASURED
from adapter.runs.score import POSITION_GOAL_M, ROTATION_GOAL_RAD, TORQUE_GOAL, counted_from

NARROW = "\u202f"  # a space that does not break, between a number and its unit
JOIN = "\u2060"  # no break here
NOTHING = "–"
GOALS = f"{ROTATION_GOAL_RAD:g}{NARROW}rad and {1e3 * POSITION_GOAL_M:g}{NARROW}mm"

REFUSALS = {
    "non_finite": "a reading was not a finite number",
    "out_of_range": "a reading lay outside what the arm can do",
    "repeated": "identical to the sample before",
    "time_backwards": "its stamp was not after the one before",
    "filter_settling": "the filter was still settling after a start or a gap",
    "at_rest": "the arm was at rest, which teaches nothing",
    "torque_saturated": "a torque was at its limit",
}


def number(value: Any, digits: int = 3) -> str:
    """A number with that many significant digits and no exponent; a dash where there is none.

    >>> number(0.012345), number(1234.5), number(None), number(1e-17)
    ('0.0123', '1235', '–', '0')
    """
    if value is None or not math.isfinite(value):
        return NOTHING
    size = abs(float(value))
    if size < 1e-9:
        return "0"
    if size < 1e-4:
        return f"{value:.1e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(size)))
    return f"{value:.{decimals}f}".replace("-", "−")


def small(value: float, unit: str) -> str:
    """A size of which less than a thousandth of the unit does not matter."""
    return f"<{NARROW}0.001{NARROW}{unit}" if value < 1e-3 else quantity(value, unit, 2)


def against(figures: Mapping[str, Any]) -> str:
    """What errors of λ are against: "documentation", or the name of the file that was given."""
    return Path(str(figures["lambda"].get("reference") or DOCUMENTATION)).name


def plus_minus(value: Any, std: Any) -> str:
    """Value ± standard deviation: the latter with two digits, the value with as many decimals.

    >>> plus_minus(0.2713, 0.0234), plus_minus(1.5, None)
    ('0.271 ± 0.023', '1.50')
    """
    if value is None or std is None or not math.isfinite(std) or std <= 0.0:
        return number(value)
    decimals = min(max(0, 1 - math.floor(math.log10(std))), 7)
    return f"{value:.{decimals}f} ± {std:.{decimals}f}".replace("-", "−")


def count(value: int) -> str:
    """A whole number in groups of three."""
    return f"{int(value):,}".replace(",", NARROW)


def quantity(value: Any, unit: str, digits: int = 3) -> str:
    """A number and its unit, on one line."""
    return f"{number(value, digits)} {unit}".replace(" ", NARROW)


def spread(values: Sequence[float], unit: str) -> str:
    """Smallest to largest, with the unit, on one line."""
    low, high = number(min(values), 2), number(max(values), 2)
    size = low if low == high else f"{low}{JOIN}–{JOIN}{high}"
    return f"{size} {unit}".replace(" ", NARROW)


def is_live(figures: Mapping[str, Any]) -> bool:
    """Whether a clock was involved, so that deadlines mean something."""
    return bool(figures.get("timing") or figures.get("lateness_us"))


def headline(figures: Mapping[str, Any]) -> str:
    """What was learned, how fast and how well, in one sentence."""
    parts = [
        schema_words(figures["lambda"], counted_from(figures)),
        *torque_words(figures["theta"]),
    ]
    samples = f"{count(figures['learned'])} of {count(figures['samples'])} samples learned"
    if is_live(figures):
        missed = figures.get("missed_deadlines") or 0
        samples += f", {count(missed)} deadline{'' if missed == 1 else 's'} missed"
    return "; ".join([*parts, samples]) + "."


def schema_words(schema: Mapping[str, Any], start: str) -> str:
    """λ's part of the headline; times count from `start`."""
    at, source = schema.get("converged_s"), schema.get("source", "")
    known = schema.get("reference") in (None, DOCUMENTATION)
    if source == LAMBDA_MEASURED:
        goal = "the documentation" if known else "the given truth"
        if at is None:
            return f"λ, measured, did not stay within {GOALS} of {goal}"
        after = quantity(at, "s", 2)
        return f"λ, measured, lies within {GOALS} of {goal} from {after} after {start} on"
    goal = "" if known else " (judged against the given truth)"
    if at is None:
        return f"λ was to reproduce the documentation but did not stay within {GOALS}{goal}"
    return f"λ reproduces the documentation {quantity(at, 's', 2)} after {start}{goal}"


def torque_words(theta: Mapping[str, Any]) -> list[str]:
    """θ's parts of the headline."""
    if theta.get("started_s") is None or not theta.get("torque_rmse_nm"):
        return ["θ was not learned, because λ had not converged"]
    words = f"torque explained to {spread(theta['torque_rmse_nm'], 'N m')} rms by joint"
    held_out = theta.get("validation_torque_rmse_nm")
    if held_out:
        words += f" ({spread(held_out, 'N m')} on data held out)"
    if theta.get("converged_s") is not None:
        after = quantity(theta["converged_s"], "s", 2)
        words += f", within {TORQUE_GOAL:g} × batch least squares from {after} on"
    parts = [words]
    for change in theta.get("changes") or []:
        load = change.get("payload")
        if load:
            parts.append(f"a load of {quantity(load['m'], 'kg')} noticed at the hand")
    return parts
