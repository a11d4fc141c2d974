"""What commands say on the terminal and write as figures; light, so a refusal comes at once.

Results go to the standard output, all else (progress, warnings, errors) to the standard error.
Names come from files and may hold anything: text is printed as it is, styles are given beside it.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    console: Console
    output: Console

DISAGREEMENT = "new disagreement"  # the label of what a monitor finds


@cache
def _consoles() -> dict[str, Console]:
    """Of results (`output`) and of all else (`console`), made when something is printed.

    They read no styles out of text, and go on where nobody listens: results are still written.
    """
    from rich.console import Console

    class PatientConsole(Console):
        def on_broken_pipe(self) -> None:
            """Whoever read this has gone (`| head`); rich would end the program here."""
            self.quiet = True
            with suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.file.fileno())

        def print(self, *objects: Any, **options: Any) -> None:
            """As rich does, without an error."""
            with suppress(OSError):
                super().print(*objects, **options)

    plain: dict[str, Any] = {"highlight": False, "markup": False, "emoji": False}
    streams = {"console": True, "output": False}
    return {name: PatientConsole(stderr=stream, **plain) for name, stream in streams.items()}


def __getattr__(name: str) -> Console:
    if name not in ("console", "output"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return _consoles()[name]


def begin(line: str) -> None:
    """What is being done, before anything that takes long is loaded (rich does, for some)."""
    with suppress(OSError):
        print(f"{line} ...", file=sys.stderr, flush=True)


def say(line: str) -> None:
    """A line about how it goes."""
    _consoles()["console"].print(line, soft_wrap=True)


def show(line: str) -> None:
    """A line of the result."""
    _consoles()["output"].print(line, soft_wrap=True)


def warn(lines: Iterable[str]) -> None:
    """Warnings, one line each."""
    for line in lines:
        labelled("warning:", "yellow", line)


def complain(sentence: object) -> None:
    """What ends the program."""
    labelled("error:", "red", str(sentence))


def labelled(label: str, style: str, line: str) -> None:
    """A line about how it goes behind a label in a style of rich."""
    from rich.text import Text

    _consoles()["console"].print(Text.assemble((label, style), " ", line), soft_wrap=True)


def print_table(heads: Iterable[Any], rows: Iterable[Iterable[Any]], **how: Any) -> None:
    """Print a table without lines; its heads are names or columns of rich's."""
    from rich.table import Table

    table = Table(*heads, box=None, pad_edge=False, **how)
    for row in rows:
        table.add_row(*row)
    _consoles()["output"].print(table)


def program_version() -> str:
    """Version of the installed distribution."""
    from importlib.metadata import PackageNotFoundError, version

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
    """Figures to a file, if one was asked for; `-` is the standard output."""
    if str(path) == "-":
        _consoles()["output"].print(json_text(figures), end="", soft_wrap=True)
    elif path is not None:
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
