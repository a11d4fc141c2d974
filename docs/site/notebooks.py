"""Execute the notebooks: `python docs/site/notebooks.py`, into runs/notebooks for the site."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from traitlets.config import Config

ROOT = Path(__file__).parents[2]
SOURCES = ROOT / "docs" / "notebooks"
RESULTS = ROOT / "runs" / "notebooks"
LONGEST_S = 600


def execute(source: Path) -> nbformat.NotebookNode:
    """The notebook with what its cells show, executed beside its file.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; names it.
    """
    notebook = nbformat.read(source, as_version=4)
    resources = {"metadata": {"path": str(source.parent)}}
    with tempfile.TemporaryDirectory() as folder:  # of sockets: no port is opened
        kernel = {"KernelManager": {"transport": "ipc", "ip": f"{folder}/kernel"}}
        client = NotebookClient(
            notebook,
            timeout=LONGEST_S,
            startup_timeout=LONGEST_S,  # a busy machine
            resources=resources,
            config=Config(kernel),
        )
        client.execute()
    return notebook


def main() -> None:
    """Execute all of them."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    for source in sorted(SOURCES.glob("*.ipynb")):
        print(f"executing {source.name}", file=sys.stderr)
        nbformat.write(execute(source), RESULTS / source.name)


if __name__ == "__main__":
    main()
