"""The documentation as a site: builds without a warning, and a page needs nothing of a network."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.helpers.pages import PAGES, ROOT

pytest.importorskip("material", reason="mkdocs-material is the extra [docs]")
pytest.importorskip("mkdocstrings", reason="mkdocstrings is the extra [docs]")

CONFIG = ROOT / "docs" / "site" / "mkdocs.yml"
LOADED = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site; `--strict` makes a warning of a page, a link or an anchor an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", str(CONFIG)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        [*command, "--site-dir", str(folder)], capture_output=True, text=True, env=quiet
    )
    assert done.returncode == 0, done.stderr
    return folder


class Loaded(HTMLParser):
    """Addresses that a browser loads for a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = dict(attrs).get(LOADED.get(tag, ""))
        if address and dict(attrs).get("rel") not in ("canonical", "next", "prev"):
            self.addresses.append(address)


def test_every_page_is_there_and_loads_only_what_the_site_has(site: Path) -> None:
    for page in PAGES:
        if page.startswith("docs/"):
            assert (site / page.removeprefix("docs/")).with_suffix(".html").exists(), page
    pages = sorted(site.rglob("*.html"))
    assert {"index.html", "drivers.html", "api.html"} <= {page.name for page in pages}
    for page in pages:
        for address in Loaded(page.read_text()).addresses:
            assert "//" not in address and not address.startswith("data:text/html"), address
            target = address.partition("#")[0].partition("?")[0]
            assert (page.parent / target).exists() or page.name == "404.html", (page, address)
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", sheet.read_text()), sheet


def test_the_reference_has_every_name(site: Path) -> None:
    import adapter

    text = (site / "api.html").read_text()
    for name in adapter.__all__:
        assert f'id="adapter.{name}"' in text, name
    assert "held_out_rmse_nm" in text and "rad/s" in text
