"""What the command lines of `tests/benchmarks` share: options, rows told and written, shares."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers.gap_scorer import wilson

Row = dict[str, Any]
HELP = {"first": "first seed"}


def options(about: str | None, **defaults: float | Path) -> argparse.ArgumentParser:
    """A parser of --json FILE and of one option for each default, which has its type."""
    parser = argparse.ArgumentParser(description=about)
    for name, value in defaults.items():
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=type(value), default=value, help=HELP.get(name))
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser


def write(path: Path | None, found: object) -> None:
    """What was found, as JSON where a file was named."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", "utf-8")


def shown(row: Row) -> str:
    """A row in one line, its numbers in four digits."""
    return " ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items())


def told(
    rows: Iterable[Row], path: Path | None = None, line: Callable[[Row], str] = json.dumps
) -> list[Row]:
    """All rows, each printed and written as it comes: what was found before an end is kept."""
    found = []
    for row in rows:
        found.append(row)
        print(line(row), flush=True)
        write(path, found)
    return found


def processor_s(pids: list[int]) -> float:
    """Processor time that processes have used."""
    total = 0.0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def share_of(what: str, hits: Sequence[bool]) -> str:
    """How many of so many, with the 95 % interval of their share."""
    low, high = wilson(sum(hits), len(hits))
    return f"{what}: {sum(hits)} of {len(hits)} ({low:.0%} to {high:.0%})"


def with_columns(Y: np.ndarray, own: Iterable[np.ndarray]) -> np.ndarray:
    """A regressor (m, n, p) with more columns, each (m, n) of a parameter that each joint has."""
    return np.concatenate([Y, *(x[:, :, None] * np.eye(Y.shape[1]) for x in own)], axis=2)


def in_processes(run: Callable[[Any], Row], jobs: Iterable[Any], count: int) -> Iterator[Row]:
    """Rows of jobs in their order, made by `count` new processes of one thread each."""
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        yield from pool.map(run, jobs)
