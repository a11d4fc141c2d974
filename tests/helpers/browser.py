"""A page in a real browser, and what in its text could fetch something."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

CHROMIUM = Path("/usr/bin/chromium")
TIMEOUT_S = 120
# Without a network of its own: nothing but this machine has an address.
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


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
        if tag in ("link", "iframe", "object", "embed", "base"):
            self.found.append(tag)


def ids_of_a_page_that_fetches_nothing(page: str) -> list[str]:
    """Assert that a page needs nothing but itself and that its ids are unique; its ids."""
    links = Links()
    links.feed(page)
    assert [link for link in links.found if not link.startswith("#")] == []
    assert not re.search(r"https?:|url\((?!#)|@import", page)
    assert "default-src 'none'" in page
    scripts = re.findall(r"<script>(.*?)</script>", page, re.S)
    assert page.count("<script") == len(scripts) == 1  # the page's own, and it is the allowed
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page
    assert len(links.ids) == len(set(links.ids))
    return links.ids


def ids_of_a_whole_page(page: str, sections: str) -> list[str]:
    """Assert that a page stands alone, is small, has these sections and no empty value; its ids."""
    assert re.findall(r'<(?:section|footer) id="(\w+)"', page) == sections.split()
    assert page.startswith("<!doctype html>") and len(page.encode()) < 2_000_000
    assert not re.search(r"\b(None|nan|null|inf|Undefined)\b", text_of(page))
    return ids_of_a_page_that_fetches_nothing(page)


def text_of(page: str) -> str:
    """What a reader sees, with plain spaces."""
    text = re.sub(r"<(style|script).*?</\1>|<[^>]+>", " ", page, flags=re.S)
    return re.sub(r"\s+", " ", html.unescape(text).replace("\u2060", ""))


def need_chromium() -> None:
    """Skip the test where there is no Chromium, which CI must have."""
    if not CHROMIUM.exists():
        assert not os.environ.get("CI"), f"CI needs {CHROMIUM}"
        pytest.skip(f"{CHROMIUM} is not installed")


FOUND = "found: "
MEASURE = """
<iframe id="page" style="width:WIDTHpx;height:900px;border:0" srcdoc="PAGE"></iframe>
<pre id="out"></pre>
<script>
addEventListener("load", () => {
  const page = document.getElementById("page").contentDocument;
  page.querySelectorAll("details").forEach((one) => { one.open = true; });
  const wide = page.documentElement.clientWidth, outside = [], lost = [];
  for (const one of page.querySelectorAll("body *")) {
    const box = one.getBoundingClientRect();
    const said = one.outerHTML.slice(0, 120);
    if (box.right > wide + 1 && !one.closest(".said, pre")) outside.push(said);
    if (one.matches("td") && box.width * box.height === 0) lost.push(said);
    const frame = one.closest(".scroll");
    if (frame && box.right > frame.getBoundingClientRect().right + 1) outside.push(said);
  }
  const answer = { wide, scrolls: page.documentElement.scrollWidth - wide, outside, lost,
    cells: page.querySelectorAll("td").length };
  document.getElementById("out").textContent = "FOUND" + JSON.stringify(answer);
});
</script>
"""


def laid_out(page: str, folder: Path, width: int) -> int:
    """Assert that a page lies within a width in Chromium, everything unfolded; cells of its tables.

    Nothing scrolls or reaches over the right edge of the page or of what a table scrolls in, and
    no cell is without area. The page runs in a frame, for no window can be so narrow.
    """
    outer = MEASURE.replace("WIDTH", str(width)).replace("FOUND", FOUND)
    text = outer.replace("PAGE", html.escape(page))
    done = _chromium(text, folder, "--virtual-time-budget=4000", "--dump-dom")
    answer = re.search(rf"{FOUND}(.*?)</pre>", done.stdout)
    assert answer is not None, done.stderr
    found = json.loads(html.unescape(answer[1]))
    assert found["wide"] <= width and found["scrolls"] <= 0
    assert found["outside"] == [] and found["lost"] == []
    return int(found["cells"])


def shown_without_complaint(
    page: str, folder: Path, least: int, size: tuple[int, int] = (1300, 1200), dark: bool = False
) -> None:
    """Assert that Chromium shows a page, in more than so many bytes of PNG, and says nothing."""
    place = folder / "page.png"
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    window = f"--window-size={size[0]},{size[1]}"
    done = _chromium(page, folder, scheme, window, f"--screenshot={place}")
    picture = place.read_bytes()
    assert [x for x in done.stderr.splitlines() if "CONSOLE" in x] == []
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > least  # more than an empty page


def _chromium(page: str, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run headless Chromium on a page.

    A browser without network: each address but that of the file itself is unknown to it. Skips
    the test where there is no Chromium, which CI must have.
    """
    need_chromium()
    path, profile = folder / "page.html", folder / "profile"
    path.write_text(page, encoding="utf-8")
    command = [
        str(CHROMIUM), *FLAGS, "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={profile}", "--enable-logging=stderr", "--v=0", *options, path.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    shutil.rmtree(profile, ignore_errors=True)
    return done


class Tab:
    """A page that is open in headless Chromium, driven over the DevTools protocol."""

    def __init__(self, socket: Any, pid: int) -> None:
        self._socket, self._number, self.pid = socket, 0, pid
        self.console: list[str] = []
        for domain in ("Runtime", "Page", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Result of a command; what the page says meanwhile goes to `console`."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=TIMEOUT_S))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            if message.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.console.append(json.dumps(message["params"])[:500])

    def size(self, width: int, height: int, dark: bool = False) -> None:
        """Show it in a window of this size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def open(self, address: str) -> None:
        """Go there; returns before all is loaded."""
        self.call("Page.navigate", url=address)

    def value(self, expression: str) -> Any:
        """Of a JavaScript expression."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, expression: str, timeout_s: float = TIMEOUT_S) -> None:
        """Until a JavaScript expression is true."""
        end = time.monotonic() + timeout_s
        while not self.value(expression):
            assert time.monotonic() < end, f"not in {timeout_s} s: {expression}"
            time.sleep(0.1)

    def picture(self) -> bytes:
        """PNG of all of the page as it looks."""
        found = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        return base64.b64decode(found["data"])


@contextmanager
def tab(folder: Path) -> Iterator[Tab]:
    """An empty page in a Chromium of its own, with a new profile in this folder."""
    need_chromium()
    profile = folder / "profile"
    command = [str(CHROMIUM), *FLAGS, "--remote-debugging-port=0", f"--user-data-dir={profile}"]
    browser = subprocess.Popen([*command, "about:blank"], stderr=subprocess.PIPE, text=True)
    try:
        assert browser.stderr is not None
        for line in browser.stderr:
            if "DevTools listening on " in line:
                break
        else:
            raise AssertionError("Chromium did not start")
        whole = line.split()[-1]
        with connect(whole, compression=None, open_timeout=TIMEOUT_S) as socket:
            socket.send(json.dumps({"id": 0, "method": "Target.getTargets"}))
            targets = json.loads(socket.recv())["result"]["targetInfos"]
        page = next(target for target in targets if target["type"] == "page")
        host = whole.split("/")[2]
        place = f"ws://{host}/devtools/page/{page['targetId']}"
        with connect(place, compression=None, max_size=None, open_timeout=TIMEOUT_S) as socket:
            yield Tab(socket, browser.pid)
    finally:
        browser.terminate()
        browser.wait(TIMEOUT_S)
        shutil.rmtree(profile, ignore_errors=True)
