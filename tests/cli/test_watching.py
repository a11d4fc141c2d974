"""A run as somebody at a terminal sees it, with the page beside it."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest

pytestmark = pytest.mark.alone

START_S = 240.0


class Terminal:
    """A command on a terminal of its own.

    Attributes:
        text: what it wrote so far, without control sequences.
    """

    def __init__(self, *arguments: str) -> None:
        self._master, slave = pty.openpty()
        environment = {**os.environ, "COLUMNS": "110", "LINES": "40", "TERM": "xterm"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "adapter", *arguments],
            stdin=slave, stdout=slave, stderr=slave, env=environment,
        )  # fmt: skip
        os.close(slave)
        self._raw = b""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        while True:
            try:
                data = os.read(self._master, 65536)
            except OSError:  # the last process has closed it
                return
            self._raw += data

    @property
    def text(self) -> str:
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self._raw.decode(errors="replace"))

    def wait_for(self, pattern: str) -> re.Match[str]:
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            found = re.search(pattern, self.text)
            if found:
                return found
            assert self.process.poll() is None, self.text
            time.sleep(0.05)
        raise AssertionError(self.text)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join(5.0)
        os.close(self._master)


def test_a_run_on_a_terminal_and_on_its_page(tmp_path: Path) -> None:
    out = str(tmp_path)
    terminal = Terminal("run", "--duration", "3", "--seed", "5", "--view", "0", "--out", out)
    try:
        address = terminal.wait_for(r"watch it: (http://127\.0\.0\.1:\d+/)").group(1)
        terminal.wait_for(r"panda_joint7 +[−\d]")  # the table, with a torque
        with urllib.request.urlopen(f"{address}state", timeout=60) as answer:
            told = json.load(answer)
        assert told["hello"]["robot"] == "panda" and told["hello"]["duration_s"] == 3.0
        assert terminal.process.wait(START_S) == 0
    finally:
        terminal.close()
    text = terminal.text
    assert re.search(r"λ (waiting|learning|converged) · θ", text)
    assert re.search(r"of \d+(\.\d+)? s · \d+ learned, \d+ wait", text)
    last = text.rindex("panda_joint7")
    assert text.index("the whole tick") > last  # results come when the table is gone
    assert (tmp_path / "report.html").exists()


def test_ports_that_are_taken_or_none(refused) -> None:
    for option, port in (("--view", "70000"), ("--foxglove", "x")):
        assert option in refused("run", option, port)
