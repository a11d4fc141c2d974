"""What mkdocs does beside its plugins: pages that stand elsewhere, figures, notebooks.

`index.md` is the README, `drivers.md` the one of `drivers`, `api.md` the names of `adapter`;
figures are drawn by `figures.py`, and pages of notebooks are made of their cells.
"""

from __future__ import annotations

import posixpath
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import adapter

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

from figures import FIGURES  # noqa: E402  # mkdocs loads this file by its path
from notebook_pages import page_of  # noqa: E402

# Pages of the site whose text stands elsewhere in the repository
ELSEWHERE = {"index.md": "README.md", "drivers.md": "drivers/README.md"}
# Pages that stand for a folder of the repository
FOLDERS = {"docs/examples": "examples.md", "docs/notebooks": "notebooks/learn-from-a-log.md"}
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#|mailto:)([^)#\s]*)(#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Leave out of the menu what is not there."""
    config.nav = [
        {name: [page for page in pages if _is_there(page)]}
        for section in config.nav or []
        for name, pages in section.items()
    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages and pictures that are not files below docs_dir."""
    for name, content in _made():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    own = page.file.src_uri
    folder = posixpath.dirname(ELSEWHERE.get(own, f"docs/{own}"))

    def moved(link: re.Match[str]) -> str:
        picture, text, target, anchor = link.groups(default="")
        path = posixpath.normpath(posixpath.join(folder, target))
        at = _address(path)
        if at is None:  # a file of the repository that is no page: its name will do
            return f"{text}"
        return f"{picture}[{text}]({posixpath.relpath(at, posixpath.dirname(own) or '.')}{anchor})"

    return LINK.sub(moved, markdown)


def _is_there(page: str) -> bool:
    made = {*ELSEWHERE, *FOLDERS.values(), "api.md"}
    notebook = ROOT / "docs" / page.replace(".md", ".ipynb")
    return page in made or notebook.exists() or (ROOT / "docs" / page).exists()


def _address(path: str) -> str | None:
    """Where a file of the repository is on the site; None where it is not."""
    for site, source in ELSEWHERE.items():
        if path == source:
            return site
    if path in FOLDERS:
        return FOLDERS[path]
    if path.startswith("recordings/") and path.endswith(".png"):
        return f"pictures/{posixpath.basename(path)}"
    if path.startswith("docs/examples/") or not path.startswith("docs/"):
        return None
    return path.removeprefix("docs/").replace(".ipynb", ".md")


def _made() -> Iterator[tuple[str, str | bytes]]:
    """Name and content of each file of the site that is made here."""
    for page, path in ELSEWHERE.items():
        yield page, (ROOT / path).read_text()
    for picture in sorted((ROOT / "recordings").glob("*.png")):
        yield f"pictures/{picture.name}", picture.read_bytes()
    yield "api.md", "\n".join(_reference())
    yield "examples.md", "\n".join(_examples())
    yield "site.css", (HERE / "site.css").read_text()
    for name, draw in FIGURES.items():
        yield f"figures/{name}.svg", draw()
    for notebook in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        for name, content in page_of(notebook, ROOT / "runs" / "notebooks" / notebook.name):
            yield f"notebooks/{name}", content


def _reference() -> Iterator[str]:
    """The names of `adapter`, functions first, each for mkdocstrings to fill in."""
    yield "# API reference\n"
    yield "Everything in `import adapter`; nothing is loaded before it is used. Units are SI,"
    yield "shapes are in brackets. `help(adapter.learn)` says the same at the prompt.\n"
    for name in adapter._FROM:  # in the order of use
        yield f"::: adapter.{name}\n"


def _examples() -> Iterator[str]:
    """The worked examples, whole; tests run them."""
    yield "# Examples\n"
    yield "Programs of less than a page. They stand in `docs/examples` and run in the tests.\n"
    for path in sorted((ROOT / "docs" / "examples").glob("*.py")):
        yield f"## `{path.name}`\n\n```python\n{path.read_text()}```\n"
