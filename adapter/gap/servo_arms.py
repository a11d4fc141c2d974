"""Servos of several arms of one kind beside each other: whose number is unlike the others'."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapter.errors import UsageError
from adapter.gap.phrases import shown_unit
from adapter.gap.servo_result import EFFECTS, SURE
from adapter.model.numbers import DASH, plain, plus_minus

LEAST_SHARE = 0.1  # of a number, to which those of simulated arms are known whatever they move


@dataclass(frozen=True)
class ServoNumber:
    """One number of all arms.

    Attributes:
        effect, joint: which, joints from 1 (0: of the whole arm).
        values, std: SI, by the arm's name, of those arms that have it.
        usual: the arms' median; unit: of them all.
        odd: arms that differ from it beyond both doubts and a tenth.
    """

    effect: str
    joint: int
    values: Mapping[str, float]
    std: Mapping[str, float]
    usual: float
    unit: str
    odd: tuple[str, ...]

    @property
    def title(self) -> str:
        """What it is, with its unit."""
        of = f" of joint {self.joint}" if self.joint else ""
        return f"{EFFECTS[self.effect][0]}{of}, {self._unit[1]}"

    @property
    def _unit(self) -> tuple[float, str]:
        return shown_unit(self.usual, self.unit)

    def cell(self, arm: str) -> str:
        """Its value on an arm, with its doubt; a dash where it was not found."""
        if arm not in self.values:
            return DASH
        factor = self._unit[0]
        return plus_minus(factor * self.values[arm], factor * self.std[arm])

    def sentences(self) -> list[str]:
        """Who differs from what."""
        factor, unit = self._unit
        title = self.title.removesuffix(f", {unit}")
        usual = plain(factor * self.usual, 3)
        return [f"{arm}: {title} is {self.cell(arm)} {unit}, usual {usual}" for arm in self.odd]


def beside(figures: Mapping[str, Any], own: str, others: Sequence[Path]) -> list[ServoNumber]:
    """The numbers of an arm beside those of others.

    Where there are three and more, the usual is their median: one odd arm does not move it.

    Args:
        figures: of this arm, as in its gap.json; own: what it is called.
        others: results of `gap` of the same kind of arm: folders, or their gap.json.

    Raises:
        UsageError: one is not such a result, or of an arm with other joints.
    """
    found: dict[tuple[str, int, str], dict[str, tuple[float, float]]] = {}
    for name, result in [(own, figures), *((_name(x), _read(x, figures)) for x in others)]:
        name += "'" * sum(name in row for row in list(found.values())[:1])
        for finding in result["findings"]:
            key = EFFECTS[finding["effect"]][1]
            unit = finding["units"][key]
            joints = [0] if finding["effect"] == "servo_delay" else finding["joints"]
            rows = zip(joints, finding["parameters"][key], finding["std"][key], strict=False)
            for joint, value, std in rows:
                found.setdefault((finding["effect"], joint, unit), {})[name] = value, std
    return [_number(*which, arms) for which, arms in sorted(found.items()) if len(arms) > 1]


def _number(
    effect: str, joint: int, unit: str, arms: Mapping[str, tuple[float, float]]
) -> ServoNumber:
    values = {name: float(value) for name, (value, _) in arms.items()}
    std = {name: float(doubt) for name, (_, doubt) in arms.items()}
    usual = float(np.median(list(values.values())))
    middle = sorted(arms, key=lambda x: abs(values[x] - usual))[: 2 - len(arms) % 2]
    doubt = max(std[x] for x in middle)  # of the usual one
    far = 2.0 if len(arms) == 2 else 1.0  # the median of two is half way
    odd = []
    for arm, value in values.items():
        least = max(SURE * float(np.hypot(std[arm], doubt)), LEAST_SHARE * abs(usual))
        odd += [arm] if far * abs(value - usual) > least else []
    return ServoNumber(effect, joint, values, std, usual, unit, tuple(odd))


def _name(path: Path) -> str:
    return (path if path.is_dir() else path.parent).resolve().name


def _read(path: Path, figures: Mapping[str, Any]) -> Mapping[str, Any]:
    file = path / "gap.json" if path.is_dir() else path
    try:
        result = json.loads(file.read_text("utf-8"))
        names, known = result["joint_names"], "tracking_rmse_rad" in result["after"]
    except (OSError, ValueError, TypeError, KeyError):
        names, known = [], False
    if not known:
        raise UsageError(f"--beside {path}: no result of gap of a position-controlled arm")
    if names != list(figures["joint_names"]):
        have = ", ".join(figures["joint_names"])
        raise UsageError(f"--beside {path}: its joints are {', '.join(names)}; this arm's {have}")
    return dict(result)
