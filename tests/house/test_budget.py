"""No room grows: lines, functions, files and upper-case constants are at most those of pyproject.

Whoever needs more takes it from somewhere: a room's numbers may rise where others' fall, the sums
may only fall. `python -m tests.house.test_budget` prints the table as it is now.
"""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
COUNTED = ("lines", "functions", "files", "constants")
CONSTANT = re.compile(r"[A-Z][A-Z0-9_]*(, [A-Z][A-Z0-9_]*)*(: [^=]+)? = ")

Counts = dict[str, list[int]]


def counts() -> Counts:
    """Room -> as `COUNTED`; a package's own files count to it, and the tests are one room."""
    found: Counts = {}
    for path in sorted(
        x for top in ("adapter", "drivers", "sim", "tests") for x in (ROOT / top).rglob("*.py")
    ):
        parts = path.relative_to(ROOT).parts
        room = parts[0] if parts[0] == "tests" or len(parts) == 2 else "/".join(parts[:2])
        text = path.read_text("utf-8")
        lines = text.splitlines()
        functions = sum(
            isinstance(x, ast.FunctionDef | ast.AsyncFunctionDef) for x in ast.walk(ast.parse(text))
        )
        own = len(lines), functions, 1, sum(bool(CONSTANT.match(line)) for line in lines)
        found[room] = [a + b for a, b in zip(found.get(room, [0] * 4), own, strict=True)]
    for name, rooms in (("all but tests", set(found) - {"tests"}), ("all", set(found))):
        found[name] = [sum(column) for column in zip(*(found[x] for x in rooms), strict=True)]
    return found


def test_no_room_is_larger_than_its_budget() -> None:
    budget = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["house"]["most"]
    have = counts()
    assert set(have) == set(budget)
    over = [
        f"{room}: {now} {what}, at most {most}"
        for room, own in have.items()
        for what, now, most in zip(COUNTED, own, budget[room], strict=True)
        if now > most
    ]
    assert not over, "; ".join(over)


if __name__ == "__main__":
    for name, numbers in counts().items():
        print(f'"{name}" = {numbers}')
