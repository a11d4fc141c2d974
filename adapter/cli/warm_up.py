"""`python -m adapter.cli.warm_up`: compile everything once, so that no first run has to wait.

Numba keeps what it compiled on disk; `make` runs this at the end of set-up.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from adapter.cli.exit_codes import ExitCode
from adapter.cli.main import main

LOG = str(Path(__file__).parents[2] / "recordings" / "panda_nominal_6s.mcap")


def warm_up() -> int:
    """A short run on the simulated arm; beside it a search for the gap and a replay.

    Nothing is kept. What one of the two processes has compiled the other one loads.
    """
    with tempfile.TemporaryDirectory() as name:
        common = ["--quiet", "--no-report", "--out"]
        live = ["run", "--scenario", "as_built", "--set", "t_s=2", "--feedforward", "learned"]
        live += ["--duration", "4", "--no-record"]
        search = ["gap", LOG, "--robot", "panda", *common, f"{name}/gap"]
        again = ["replay", LOG, *common, f"{name}/again"]
        lanes = [[*live, *common, f"{name}/run"]], [search, again]
        with ProcessPoolExecutor(len(lanes), get_context("spawn")) as processes:
            return max(processes.map(_give, lanes))


def _give(lines: list[list[str]]) -> int:
    """Give command lines one after the other; the worst exit code. Nothing has to converge."""
    return max((code for code in map(main, lines) if code != ExitCode.NOT_CONVERGED), default=0)


if __name__ == "__main__":
    raise SystemExit(warm_up())
