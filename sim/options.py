"""What can be asked of a simulated arm, by name, and how a served one ends.

Light, so that wrong use is told at once.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from drivers.errors import choices
from drivers.files.bounded import parse_json
from drivers.process import StopSignals
from sim.noise_levels import NOISES, check_levels

DEFAULT_SCENARIO = "nominal"
ROBOTS = ("panda", "fr3")
COMMON_OPTIONS = ("noise", "links", "levels", "imus", "trouble", "robot")
TROUBLES = ("held", "wall", "floor", "load", "t_s", "push", "k")


class ScenarioKind(NamedTuple):
    """What a scenario offers: options (numbers from 0 up), and whether links are measured."""

    options: tuple[str, ...] = ()
    links: bool = False


SCENARIOS = {
    "nominal": ScenarioKind(),
    "bent_link": ScenarioKind(("angle_deg", "offset_m"), links=True),
    "payload_at_20s": ScenarioKind(("mass", "t_s")),
    "friction": ScenarioKind(),
    "real_drives": ScenarioKind(),
    "as_built": ScenarioKind(("mass", "t_s", "error")),
    "wall_mounted": ScenarioKind(),
}


def check(name: str, options: Mapping[str, Any]) -> dict[str, float]:
    """The scenario's own options as numbers.

    Raises:
        ValueError: unknown scenario, option, noise or level, or a value out of range; with choices.
    """
    if name not in SCENARIOS:
        raise ValueError(f"no scenario {name!r}; {choices(name, SCENARIOS)}")
    own = SCENARIOS[name].options
    for key in options.keys() - {*own, *COMMON_OPTIONS}:
        raise ValueError(f"{name} has no option {key!r}; {choices(key, own + COMMON_OPTIONS)}")
    numbers = {key: _size(name, key, options[key]) for key in own if key in options}
    links, noise = options.get("links", False), options.get("noise", NOISES[0])
    if not isinstance(links, bool):
        raise ValueError(f"{name}: links is {links!r}; have: True, False")
    if noise not in NOISES:
        raise ValueError(f"no noise {noise!r}; {choices(noise, NOISES)}")
    if options.get("robot", ROBOTS[0]) not in ROBOTS:
        raise ValueError(f"no robot {options['robot']!r}; {choices(options['robot'], ROBOTS)}")
    check_levels(options.get("levels", {}))
    imus = options.get("imus", [])
    if not isinstance(imus, list) or not all(isinstance(x, str) for x in imus):
        raise ValueError(f'{name}: imus is {imus!r}; have: ["LINK", ...]')
    trouble = options.get("trouble", {})
    if not isinstance(trouble, dict) or not trouble.keys() <= set(TROUBLES):
        raise ValueError(f"trouble is {trouble!r}; have: a table of {', '.join(TROUBLES)}")
    for key in trouble.keys() - {"held", "push"}:
        _size("trouble", key, trouble[key])
    push = trouble.get("push", 0.0)
    if not isinstance(push, int | float) or not math.isfinite(push):
        raise ValueError(f"trouble: push is {push!r}; have: a number, N m, of either sign")
    held = trouble.get("held", [])
    if not isinstance(held, list) or not all(type(j) is int and j > 0 for j in held):
        raise ValueError(f"trouble: held is {held!r}; have: [NUMBER OF A JOINT, ...]")
    return numbers


def options_of(texts: Sequence[str]) -> dict[str, Any]:
    """Options of a scenario from KEY=VALUE texts; values are JSON, or text as it stands.

    Raises ValueError for a text without a key.
    """
    found: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--set takes KEY=VALUE, got '{text}'")
        try:
            found[key] = parse_json(value)
        except ValueError:
            found[key] = value
    return found


def add_served(
    parser: argparse.ArgumentParser,
    faults: str,
    of_set: str = "as in noise=none",
    default: str = DEFAULT_SCENARIO,
) -> None:
    """Declare what every served arm is asked for: which one, its faults, how long, a summary.

    Args:
        parser: of its options.
        faults: there are, one line each, below what they begin with.
        of_set: more about `--set`.
        default: scenario.
    """
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = f"faults, NAME[=VALUE][@SECONDS]{faults}"
    add = parser.add_argument
    words = f"{', '.join(SCENARIOS)}; {default} by default"
    add("--scenario", default=default, metavar="NAME", help=words)
    words = f"option of the scenario, {of_set}"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=words)
    add("--seed", type=int, default=0, help="of the arm, noise and faults")
    add("--fault", action="append", default=[], metavar="FAULT", help="see below; repeatable")
    add("--duration", type=float, metavar="S", help="end after so many seconds")
    add("--json", type=Path, metavar="FILE", help="write the summary there as well")


def _size(name: str, key: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = -1.0
    if not 0.0 <= number < math.inf:
        raise ValueError(f"{name}: {key} is {value!r}; have: numbers from 0 up")
    return number


class Ending(StopSignals):
    """How a served arm ends: at SIGTERM, SIGINT or SIGHUP, or when its time is over.

    To be entered in the main thread; the signals have their usual effect again behind it.

    Args:
        duration_s: None for no end but a signal.
    """

    def __init__(self, duration_s: float | None) -> None:
        super().__init__()
        self._end_s = math.inf if duration_s is None else time.monotonic() + duration_s

    def is_set(self) -> bool:
        """Whether to end."""
        return self.count > 0 or time.monotonic() >= self._end_s


def sum_up(summary: Mapping[str, Any], lines: str | None, path: Path | None) -> None:
    """Say what happened, in these lines or one for each number, and write it where wanted."""
    print(lines or "\n".join(f"{key}: {value}" for key, value in summary.items()), flush=True)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(summary, indent=1) + "\n", "utf-8")
