"""The README's text, and its commands given as a shell would."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

PATIENCE_S = 1500.0  # with a command, on a machine with other work
HUMANOID = "adapter experiment atlas"  # given by tests/experiments/test_experiment.py
ROOT = Path(__file__).parents[2]
SHELL = r"```sh\n(.*?)```"
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Fenced blocks of a language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands(block: str) -> list[str]:
    """The adapter's commands of a block, without comments."""
    lines = (line.partition("#")[0].strip() for line in block.splitlines())
    return [line for line in lines if line.startswith("adapter ")]


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
