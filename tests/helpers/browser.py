"""A page in a real browser, and what in its text could fetch something."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest

CHROMIUM = Path("/usr/bin/chromium")
TIMEOUT_S = 120


class Links(HTMLParser):
    """Everything in a page that could fetch something, and every id."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "action", "data", "poster", "srcset"):
                self.found.append(value)
        if tag in ("script", "link", "iframe", "object", "embed", "base"):
            self.found.append(tag)


def ids_of_a_page_that_fetches_nothing(page: str) -> list[str]:
    """Assert that a page needs nothing but itself and that its ids are unique; its ids."""
    links = Links()
    links.feed(page)
    assert [link for link in links.found if not link.startswith("#")] == []
    assert not re.search(r"https?:|url\((?!#)|@import", page)
    assert "default-src 'none'" in page
    assert len(links.ids) == len(set(links.ids))
    return links.ids


def screenshot(
    page: str, folder: Path, size: tuple[int, int] = (1300, 1200), dark: bool = False
) -> tuple[bytes, list[str]]:
    """PNG of a page in headless Chromium, and what it said on its console.

    A browser without network: each address but that of the file itself is unknown to it. Skips
    the test where there is no Chromium, which CI must have.
    """
    if not CHROMIUM.exists():
        assert not os.environ.get("CI"), f"CI needs {CHROMIUM}"
        pytest.skip(f"{CHROMIUM} is not installed")
    path, picture, profile = folder / "page.html", folder / "page.png", folder / "profile"
    path.write_text(page, encoding="utf-8")
    command = [
        str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
        "--no-first-run", "--disable-background-networking", "--disable-component-update",
        "--disable-sync", "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={profile}", "--enable-logging=stderr", "--v=0",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
        f"--window-size={size[0]},{size[1]}", f"--screenshot={picture}", path.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    shutil.rmtree(profile, ignore_errors=True)
    return picture.read_bytes(), [x for x in done.stderr.splitlines() if "CONSOLE" in x]
