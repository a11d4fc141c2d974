"""From a template and what it shows to a file with the page."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from adapter.run_folder import RunFolderError


def fill(template: str, context: dict[str, Any]) -> str:
    """The page as HTML text; everything that is not markup already is escaped."""
    environment = Environment(
        loader=PackageLoader("adapter", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(context)


def write_whole(path: str | Path, page: str) -> Path:
    """Write the page, whole or not at all. Returns the path.

    Raises:
        RunFolderError: the file cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(path.name + ".part")
        beside.write_text(page, encoding="utf-8")
        os.replace(beside, path)
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be written: {error.strerror}") from error
    return path
