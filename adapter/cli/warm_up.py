"""`python -m adapter.cli.warm_up`: compile everything once, so that no first run has to wait.

Numba keeps what it compiled on disk; `make` runs this at the end of set-up.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from adapter.cli.main import main


def warm_up() -> int:
    """A short run and its replays, on the simulated arm; nothing of it is kept."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = str(folder / "warm.mcap")
        common = ["--quiet", "--no-report", "--out", name]
        live = ["run", "--duration", "3", "--scenario", "bent_link", "--record", recording]
        code = main([*live, *common])
        for every in ("1", "10"):
            code = code or main(["replay", recording, "--every", every, *common])
        live = ["run", "--duration", "3", "--scenario", "friction", "--no-record"]
        return code or main([*live, *common])


if __name__ == "__main__":
    raise SystemExit(warm_up())
