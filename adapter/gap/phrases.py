"""Numbers with their units and doubt, and the sentence that says what was found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adapter.effects.base import ALL, BASE, FLANGE, LINK, with_squares
from adapter.effects.catalogue import KNOWN
from adapter.effects.phrases import Length, Phrase
from adapter.gap.result import Finding
from adapter.model.inertia import PARAMETERS, UNITS
from adapter.model.numbers import plain, plus_minus

SHOWN_UNITS = {"1": (100.0, "%"), "s": (1e3, "ms"), "s2": (1e6, "ms²"), "m": (1e3, "mm")}


def measured(value: Any, std: Any, unit: str) -> str:
    """Value ± standard deviation in the unit that people use.

    >>> measured(0.05, 0.0021, "1"), measured(0.0123, 0.0002, "rad")
    ('5.00 ± 0.21 %', '12.30 ± 0.20 mrad')
    """
    factor, name = shown_unit(value, unit)
    return f"{plus_minus(factor * _number(value), factor * _number(std))} {name}".rstrip()


def shown_unit(value: Any, unit: str) -> tuple[float, str]:
    """(factor, name) of the unit in which a value of a file's unit is shown."""
    if unit == "rad" and 0.0 < abs(_number(value)) < 0.1:  # angles below it are shown in mrad
        return 1e3, "mrad"
    return SHOWN_UNITS.get(unit, (1.0, with_squares(unit)))


def parameter(finding: Finding, key: str, size: bool = False) -> str:
    """One parameter, a number, of a finding; `size`: without its sign."""
    value, std = _number(finding.parameters.get(key)), _number(finding.std.get(key))
    unit = finding.units.get(key, "")
    if unit == "per turn" and math.isfinite(value) and not (math.isfinite(std) and std):
        return f"{value:g} {unit}"  # a whole number that was chosen, not fitted
    return measured(abs(value) if size else value, std, unit)


def parameter_lines(finding: Finding) -> list[str]:
    """The numbers of a finding, one line each: "Fc = 2.000 ± 0.030 N m"."""
    lines = []
    for key, value in finding.parameters.items():
        if np.ndim(value) == 0:
            lines.append(f"{key} = {parameter(finding, key)}")
    for length in phrase_of(finding).lengths:
        if length.name:
            lines.append(f"{length.name} {norm(finding, length)}")
    if "dtheta" in finding.parameters:
        # the surest parts of a change of ten, in standard deviations of each
        std, value = finding.std.get("dtheta"), np.asarray(finding.parameters["dtheta"], float)
        doubt = np.full(10, np.nan) if std is None else np.asarray(std, dtype=float)
        usable = np.isfinite(doubt) & (doubt > 0.0)
        surety = np.where(usable, np.abs(value) / np.where(usable, doubt, 1.0), 0.0)
        if not usable.any():
            surety = np.abs(value)
        for k in sorted(k for k in np.argsort(-surety)[:4] if surety[k] > 0.0):
            lines.append(f"Δ{PARAMETERS[k]} = {plus_minus(value[k], doubt[k])} {UNITS[k]}")
    return lines


def norm(finding: Finding, length: Length) -> str:
    """Length of a vector of parameters ± its standard deviation, in the unit it is shown in."""
    value = _components(finding, length)
    std = np.array([_number(finding.std.get(key)) for key in length.keys], dtype=float)
    size = float(np.linalg.norm(value))
    doubt = float(np.linalg.norm(value * std)) / size if size > 0.0 else math.nan
    text = plus_minus(length.factor * size, length.factor * doubt)
    return f"{text}{length.unit}" if length.unit == "°" else f"{text} {length.unit}"


def _components(finding: Finding, length: Length) -> np.ndarray:
    return np.array([_number(finding.parameters.get(key)) for key in length.keys])


def phrase_of(finding: Finding) -> Phrase:
    """How the effect of a finding is said to be there."""
    return KNOWN[finding.effect].phrase if finding.effect in KNOWN else Phrase()


def who(effect: str, joints: Sequence[int]) -> str:
    """What an effect acts on: "joint 4", "joints 1 and 2", "link 5", "all joints", "the flange"."""
    scope = KNOWN[effect].scope if effect in KNOWN else ""
    if scope in (FLANGE, BASE):
        return f"the {scope}"
    if not joints:
        return "all joints" if scope == ALL else "the arm"
    name = "link" if scope == LINK else "joint"
    return f"{name}{'s' if len(joints) > 1 else ''} {numbered(joints)}"


def numbered(joints: Sequence[int]) -> str:
    """Numbers of joints: "1, 2 and 4", or "1 to 7" for a run of them.

    >>> numbered([4]), numbered([1, 2, 4]), numbered([1, 2, 3, 4])
    ('4', '1, 2 and 4', '1 to 4')
    """
    run = len(joints) > 2 and list(joints) == list(range(joints[0], joints[-1] + 1))
    return f"{joints[0]} to {joints[-1]}" if run else listed([str(j) for j in joints])


def listed(items: Sequence[str]) -> str:
    """Items with commas, and "and" before the last."""
    return " and ".join([", ".join(items[:-1]), items[-1]]) if len(items) > 1 else "".join(items)


def phrase(finding: Finding) -> str:
    """What is missing and how much of it, without when."""
    known = phrase_of(finding)
    if finding.two_readings:
        x, less = parameter(finding, "m", size=True), _number(finding.parameters.get("m")) < 0.0
        load, link = (f"{x} less", "lighter") if less else (f"a load of {x}", "heavier")
        return f"{load} at the hand (or the last link {link} by that: this log cannot tell)"
    main = finding.parameters.get(known.key)
    template = known.less if known.less and _number(main) < 0.0 else known.more
    several, worth = len(finding.joints) > 1, np.asarray(finding.torque_rms_nm, dtype=float)
    values: Mapping[str, str] = {
        key: parameter(finding, key)
        for key, value in finding.parameters.items()
        if np.ndim(value) == 0
    }
    derived = {
        "who": who(finding.effect, finding.joints),
        "lacks": "lack" if several else "lacks",
        "has": "have" if several else "has",
        "is": "are" if several else "is",
        "x": parameter(finding, known.key, size=True) if known.key else "",
        "torque": f"{plain(np.max(worth), 2)} N m of torque"
        if worth.size
        else "its torque differs",
        "title": finding.title,
    }
    if known.lengths:
        shown = (x for x in known.lengths if np.nan_to_num(_components(finding, x)).any())
        length = next(shown, known.lengths[-1])
        derived["length"] = length.before + norm(finding, length)
    return template.format_map({**values, **derived})


def _number(value: Any) -> float:
    """A value, NaN where there is none."""
    return math.nan if value is None else float(value)
