"""Licences of all that `pip install panda-adapter` brings, and of each extra, as a table.

    PYTHONPATH=. python tests/benchmarks/licences.py

As the installed packages state them. What is not installed here is listed without a licence.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
UNKNOWN = "not installed here"
LONGEST = 60  # characters; some packages put the whole text where its name belongs


def needed(requirements: Iterable[Requirement]) -> set[str]:
    """Names of distributions that these requirements bring, with what they need in turn."""
    found: set[str] = set()
    waiting = [(requirement, {""}) for requirement in requirements]
    while waiting:
        requirement, wanted = waiting.pop()
        if requirement.marker and not any(
            requirement.marker.evaluate({"extra": extra}) for extra in wanted
        ):
            continue
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if name in found and not requirement.extras:
            continue
        found.add(name)
        try:
            more = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        waiting += [(Requirement(text), {"", *requirement.extras}) for text in more]
    return found


def licence(name: str) -> str:
    """What a distribution says its licence is."""
    try:
        told: Any = metadata.metadata(name)  # a message, as of e-mail
    except metadata.PackageNotFoundError:
        return UNKNOWN
    classified = [
        text.rpartition(" :: ")[2]
        for text in told.get_all("Classifier") or []
        if text.startswith("License :: ") and not text.endswith("OSI Approved")
    ]
    written = str(told.get("License") or "").strip().splitlines()
    short = written[0] if written and len(written[0]) <= LONGEST else ""
    return told.get("License-Expression") or ", ".join(classified) or short or "not stated"


def core() -> dict[str, str]:
    """Licence of everything that comes without an extra, by name."""
    return {
        name: licence(name) for name in sorted(needed(map(Requirement, PROJECT["dependencies"])))
    }


def extra(name: str) -> dict[str, str]:
    """The same of what an extra brings beside that."""
    own = map(Requirement, PROJECT["optional-dependencies"][name])
    return {name: licence(name) for name in sorted(needed(own) - set(core()))}


def main() -> None:
    """Print the tables."""
    tables = {"without extras": core()}
    tables |= {f"extra [{name}]": extra(name) for name in PROJECT["optional-dependencies"]}
    for title, rows in tables.items():
        print(f"\n## {title}\n\n| package | licence |\n|---|---|")
        for name, told in rows.items():
            print(f"| {name} | {told} |")


if __name__ == "__main__":
    main()
