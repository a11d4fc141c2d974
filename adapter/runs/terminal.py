"""What commands say on the terminal and write as figures; light, so a refusal comes at once."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from rich.console import Console


class PatientConsole(Console):
    """Goes on where the terminal is gone: results are still written."""

    def print(self, *objects: Any, **options: Any) -> None:
        """As rich does, without an error."""
        with suppress(OSError):
            super().print(*objects, **options)


console = PatientConsole(stderr=True, highlight=False)


def warn(lines: Iterable[str]) -> None:
    """Warnings, one line each."""
    for line in lines:
        console.print(f"[yellow]warning:[/] {line}", soft_wrap=True)


def program_version() -> str:
    """Version of the installed distribution."""
    try:
        return version("panda-adapter")
    except PackageNotFoundError:
        return "0 (not installed)"


def json_ready(value: Any) -> Any:
    """The same as plain JSON values: numpy's types made Python's, what is not finite None."""
    if isinstance(value, Mapping):
        return {str(key): json_ready(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(part) for part in value]
    if hasattr(value, "tolist"):  # arrays and scalars of numpy
        return json_ready(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def json_text(figures: Any) -> str:
    """Figures as JSON, with a line end; see `json_ready`."""
    return json.dumps(json_ready(figures), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write_json(path: Path | None, figures: Any) -> None:
    """Figures to a file, if one was asked for."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json_text(figures), encoding="utf-8")


def check_writable(path: Path | None) -> None:
    """Before long work: raises OSError where a file that was asked for cannot be written."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        there = path.exists()
        path.open("a").close()
        if not there:
            path.unlink()


def results_folder(out: Path | None, kind: str) -> Path:
    """The folder results go to: the one asked for, or a new one in runs/."""
    folder = out or Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{kind}"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
