"""`python -m adapter.cli.warm_up`: compile everything once, so that no first run has to wait.

Numba keeps what it compiled on disk; `make` runs this at the end of set-up.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from adapter.cli.main import main


def warm_up() -> int:
    """Short runs, replays and a search for the gap, on the simulated arm; nothing is kept."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = str(folder / "warm.mcap")
        common = ["--quiet", "--no-report", "--out", name]
        live = ["run", "--duration", "3", "--scenario", "bent_link", "--record", recording]
        code = main([*live, *common])
        for every in ("1", "10"):
            code = code or main(["replay", recording, "--every", every, *common])
        rubbing = str(folder / "rubbing.mcap")
        live = ["run", "--duration", "6", "--scenario", "friction", "--record", rubbing]
        code = code or main([*live, *common])
        return code or main(["gap", rubbing, "--model", "panda", *common])


if __name__ == "__main__":
    raise SystemExit(warm_up())
