"""What the subcommands share: options, output, the documented robot."""

from __future__ import annotations

import argparse
import dataclasses
import json
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from adapter.config import REAL_ARM_EFFECTS, Config, config_from, config_table, read_config
from adapter.effects import LEARNED
from adapter.errors import SettingsError
from adapter.known_effects import learnable, not_taken_off
from adapter.learner import MODES
from adapter.model import SelfModel
from adapter.robots import documented


class PatientConsole(Console):
    """Goes on where the terminal is gone: results are still written."""

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich does, without an error."""
        with suppress(OSError):
            super().print(*objects, **options)


console = PatientConsole(stderr=True, highlight=False)


class UsageError(ValueError):
    """The command line asks for something that does not exist; the message names the choices."""


def program_version() -> str:
    """Version of the installed distribution."""
    try:
        return version("panda-adapter")
    except PackageNotFoundError:
        return "0 (not installed)"


def add_learning_options(parser: argparse.ArgumentParser) -> None:
    """Options of everything that learns."""
    parser.add_argument(
        "--robot", metavar="NAME|FILE", help="documented robot: panda (default), .urdf or .json"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings in TOML")
    parser.add_argument("--mode", choices=MODES, help="moments (default) or the paper's sample")
    parser.add_argument(
        "--effects",
        metavar="LIST",
        help="effects learned beside θ: none, real, or names with commas between "
        f"({', '.join(LEARNED)})",
    )
    parser.add_argument("--seed", type=int, help="of every random choice")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="model or truth to compare with")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where results go")
    parser.add_argument("--no-report", action="store_true", help="do not write the HTML page")
    parser.add_argument("--resume", type=Path, metavar="FILE", help="go on from a checkpoint")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """--json for commands without other figures."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")


def robot_of(name: str | None) -> SelfModel:
    """The documented robot by name or file."""
    return documented(name or "panda")


def configure(
    args: argparse.Namespace,
    recorded: dict[str, Any] | None,
    default_effects: tuple[str, ...],
    robot: SelfModel,
) -> Config:
    """Settings: the defaults, over them those a recording was made with, a file, the options.

    Args:
        recorded: the configuration in a recording of ours, None elsewhere.
        default_effects: learned where nobody said otherwise.
        robot: effects that it has and that can be learned are, where nobody says otherwise.
    """
    if args.config is not None or recorded is None:
        config = read_config(args.config)
    else:
        config = config_from(recorded, "configuration in the recording")
    learner = config.pipeline.learner
    changes: dict[str, Any] = {}
    if args.effects is not None:
        changes["effects"] = _effects(args.effects)
    else:
        by_default = recorded is None and not learner.effects
        changes["effects"] = learnable(robot, default_effects if by_default else learner.effects)
    warn([f"{robot.name}: the learner leaves out {name}" for name in not_taken_off(robot)])
    if args.mode is not None:
        changes["mode"] = args.mode
    if args.seed is not None:
        changes["seed"] = args.seed
    learner = dataclasses.replace(learner, **changes)
    pipeline = dataclasses.replace(config.pipeline, learner=learner)
    excitation = config.excitation
    if args.seed is not None:
        excitation = dataclasses.replace(excitation, seed=args.seed)
    return dataclasses.replace(config, pipeline=pipeline, excitation=excitation)


def _effects(text: str) -> tuple[str, ...]:
    if text == "none":
        return ()
    if text == "real":
        return REAL_ARM_EFFECTS
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in LEARNED:
            raise SettingsError(f"no effect '{name}'; have: none, real, {', '.join(LEARNED)}")
    return names


def recording_metadata(
    config: Config, robot: SelfModel, command: str, **more: Any
) -> dict[str, Any]:
    """What a recording carries so that a replay repeats the run."""
    return {
        "config": config_table(config),
        "version": program_version(),
        "robot": robot.name,
        "command": command,
        **more,
    }


def plain(value: Any) -> Any:
    """JSON values of numpy ones; what is not finite becomes null."""
    if isinstance(value, dict):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def write_json(path: Path | None, figures: Any) -> None:
    """Figures to a file, if one was asked for."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(plain(figures), indent=1, ensure_ascii=False) + "\n")


def check_writable(path: Path | None) -> None:
    """Before long work: raises OSError where a file that was asked for cannot be written."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        there = path.exists()
        path.open("a").close()
        if not there:
            path.unlink()


def warn(lines: list[str]) -> None:
    """Warnings, one line each."""
    for line in lines:
        console.print(f"[yellow]warning:[/] {line}", soft_wrap=True)
