"""`python -m adapter.cli.warm_up`: compile everything once, so that no first run has to wait.

Numba keeps what it compiled on disk; `make` runs this at the end of set-up.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from adapter.cli.main import main


def warm_up() -> int:
    """Short runs on the simulated arm, a replay and a search for the gap; nothing is kept.

    While the first run compiles, the arm's log gets holes; the search needs one without.
    """
    with tempfile.TemporaryDirectory() as name:
        compiling, recording = (str(Path(name) / f"{n}.mcap") for n in ("compiling", "warm"))
        common = ["--quiet", "--no-report", "--out", name]
        live = ["run", "--scenario", "friction", *common]
        code = main([*live, "--duration", "3", "--record", compiling])
        code = code or main(["replay", compiling, "--every", "10", *common])
        code = code or main([*live, "--duration", "6", "--record", recording])
        return code or main(["gap", recording, "--model", "panda", *common])


if __name__ == "__main__":
    raise SystemExit(warm_up())
