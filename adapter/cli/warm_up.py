"""`python -m adapter.cli.warm_up`: compile everything once, so that no first run has to wait.

Numba keeps what it compiled on disk; `make` runs this at the end of set-up.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from adapter.cli.main import main


def warm_up() -> int:
    """A short run on the simulated arm, its replay and a search for the gap; nothing is kept."""
    with tempfile.TemporaryDirectory() as name:
        recording = str(Path(name) / "warm.mcap")
        common = ["--quiet", "--no-report", "--out", name]
        live = ["run", "--duration", "6", "--scenario", "friction", "--record", recording]
        code = main([*live, *common])
        code = code or main(["replay", recording, "--every", "10", *common])
        return code or main(["gap", recording, "--model", "panda", *common])


if __name__ == "__main__":
    raise SystemExit(warm_up())
