"""What users read, README and pages, and its commands given as a shell would."""

import argparse
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from adapter.cli.main import build_parser

PATIENCE_S = 1500.0  # with a command, on a machine with other work
ROOT = Path(__file__).parents[2]
SHELL, PYTHON = "sh", "python"

# What `tests/docs` does not give word for word, by what stands in it, and why
NOT_GIVEN = {
    "172.16.0.2": "a real Franka robot; simulated ones are in simulated-hardware.md",
    "can://can0": "a real CAN bus; a simulated one is in simulated-hardware.md",
    "adapter sim fci --": "its options: tests/sim",
    "adapter excite": "minutes of search; tests/cli/test_excite.py gives it with a nearer goal",
    "--motion runs/motion": "what that wrote; tests/cli/test_excite.py and test_played.py play one",
    "write_a_driver.py": "given by tests/drivers/test_own_driver.py",
    "so101": "of a data set that tests/docs/test_servo_hour.py makes",
    "adapter completion": "given by tests/cli/test_clumsy.py",
    "adapter experiment atlas": "a small one is given by tests/experiments/test_experiment.py",
}

WIRE = ("adapter sim ", "://")  # in commands for simulated hardware


# Text of each page by its path from the root: first README and the tour, then by name.
_first = [ROOT / "README.md", ROOT / "docs" / "five-minutes.md"]
_rest = sorted({*(ROOT / "docs").glob("*.md")} - {*_first})
_paths = [*_first, *_rest, ROOT / "drivers" / "README.md"]
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in _paths}


def blocks(language: str, page: str | None = None) -> list[str]:
    """Fenced blocks of a language in order, of one page or of all."""
    texts = PAGES.values() if page is None else [PAGES[page]]
    return [b for text in texts for b in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)]


def commands(block: str) -> list[str]:
    """The adapter's commands of a block, without comments."""
    lines = (line.partition("#")[0].strip() for line in block.splitlines())
    return [line for line in lines if line.startswith("adapter ")]


def every_command() -> list[str]:
    """The adapter's commands of all pages, each once, in the order of pages."""
    return list(dict.fromkeys(line for block in blocks(SHELL) for line in commands(block)))


def given(wire: bool = False) -> list[str]:
    """Those of them that tests give word for word: for simulated hardware, or all others."""
    ours = [line for line in every_command() if not any(part in line for part in NOT_GIVEN)]
    return [line for line in ours if any(part in line for part in WIRE) == wire]


def environment(folder: Path) -> dict[str, str]:
    """As a shell has it in which the project's own was activated."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PANDA_ADAPTER_CACHE": str(folder / "cache")}


def give(line: str, folder: Path, codes: tuple[int, ...] = (0,)) -> tuple[int, str]:
    """Run a command line as a shell would; its exit code, one of these, and its complaints."""
    done = subprocess.run(
        shlex.split(line),
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode in codes, f"{line}\n{done.stderr}"
    return done.returncode, done.stderr


def options_of_commands() -> dict[str, dict[tuple[str, str], list[str]]]:
    """Each option of the command line: what it takes and its sense, with the commands that mean it
    so; words that are taken for another one are left out."""
    parts = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    found: dict[str, dict[tuple[str, str], list[str]]] = {}
    for command, part in parts.choices.items():
        for action in part._actions:
            said = action.help or ""
            for name in (x for x in action.option_strings if x.startswith("--") and x != "--help"):
                takes = action.metavar or "|".join(map(str, action.choices or ()))
                takes = " ".join(takes) if isinstance(takes, tuple) else takes
                if said != argparse.SUPPRESS:
                    senses = found.setdefault(name, {})
                    senses.setdefault((takes, said.replace("%%", "%")), []).append(command)
    return found


def table_of_options() -> str:
    """The table of docs/commands.md; `python -m tests.helpers.pages` prints it.

    Of a sense it has what stands before a colon, bracket or semicolon; --help has the rest.
    """
    rows: dict[tuple[str, ...], list[str]] = {}
    for name, senses in sorted(options_of_commands().items()):
        for (takes, said), commands in senses.items():
            said = re.sub(r"^((?:\S+ ){2,}?\S+?)(?:[:;] | \().*", r"\1", said)
            takes = " ".join(f"`{x}`" for x in takes.split("|") if x)
            rows.setdefault((f"`{name}`", takes, said), []).extend(commands)
    lines = ["| option | takes | sense | commands |", "|---|---|---|---|"]
    for cells, commands in rows.items():
        lines.append(f"| {' | '.join((*cells, ', '.join(dict.fromkeys(commands))))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table_of_options())
