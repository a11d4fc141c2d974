"""A notebook as a page: its text, its code, and what its cells showed where it was executed."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat

Part = tuple[str, str | bytes]  # name of a file of the site, and what is in it


def page_of(source: Path, executed: Path) -> list[Part]:
    """The page of a notebook and its pictures, by name.

    Args:
        source: the notebook, without outputs.
        executed: where `make docs` leaves it with outputs; need not be there, and is not used
            where the notebook has changed since.
    """
    cells = nbformat.read(source, as_version=4).cells
    if executed.exists():
        ran = nbformat.read(executed, as_version=4).cells
        cells = ran if [c.source for c in ran] == [c.source for c in cells] else cells
    lines: list[str] = []
    pictures: list[Part] = []
    for cell in cells:
        if cell.cell_type == "markdown":
            lines += [cell.source, ""]
            continue
        lines += ["```python", cell.source, "```", ""]
        for output in cell.get("outputs", ()):
            name = f"{source.stem}-{len(pictures) + 1}.png"
            lines += _shown(output, name, pictures)
    where = f"*This page is the notebook `docs/notebooks/{source.name}`: open it with Jupyter.*"
    return [(f"{source.stem}.md", "\n".join([*lines, where, ""])), *pictures]


def _shown(output: Any, picture: str, pictures: list[Part]) -> Iterator[str]:
    """Lines of one output: a picture, a table, or text."""
    data = output.get("data", {})
    if "image/png" in data:
        pictures.append((picture, base64.b64decode(data["image/png"])))
        yield f"![What the cell drew]({picture})"
    elif "text/html" in data:
        yield f'<div class="shown">{"".join(data["text/html"].splitlines())}</div>'
    else:
        text = data.get("text/plain", output.get("text", ""))
        yield from ("```text", text.rstrip("\n"), "```")
    yield ""
