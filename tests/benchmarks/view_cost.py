"""What being watched costs the loop: `PYTHONPATH=. python tests/benchmarks/view_cost.py`.

One live run of the simulated Panda, cut into pairs of stretches: without the view (its process
stopped, the browser on an empty page) and with it (drawn in headless Chromium); which comes first
alternates. The loop's own counts are read at the edges.

The view runs only where nobody else wants the processor, so that on a busy machine it costs
nothing.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from soak import family

from adapter.realtime.shared import SHM_FOLDER, SharedBlock
from adapter.realtime.timing import BLOCK_BYTES, LoopBoard, LoopTiming
from tests.helpers.benchmark import options, processor_s, write
from tests.helpers.browser import Tab, tab

SETTLE_S, EDGE_S = 4.0, 1.5  # after the first frame, and after each change of what is shown
ENDLESS_S = 3600.0  # a run that is measured is stopped when that is done
START_S = 180.0
WATCHED = ("loop_us", "tick_us", "lateness_us")
SHARES = (50.0, 99.0)
EMPTY = "about:blank"


@contextmanager
def live_run(folder: Path) -> Iterator[tuple[int, str]]:
    """The process of `adapter run`, and where it can be watched."""
    command = [sys.executable, "-u", "-m", "adapter", "run", "--duration", str(ENDLESS_S)]
    command += ["--seed", "5", "--quiet", "--out", str(folder), "--view", "0"]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        address = ""
        assert run.stderr is not None
        while not address:
            line = run.stderr.readline()
            found = re.search(r"http://\S+", line)
            address = found.group(0) if found else ""
            if not line:
                raise SystemExit("the run did not start")
        yield run.pid, address
    finally:  # what it has learned and recorded is of no interest, and may take long to finish
        for pid in reversed(family(run.pid)):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        run.communicate()


def view_process(run: int) -> tuple[int, str]:
    """The process that serves the page, and the name of the loop's board in shared memory."""
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        for pid in family(run)[1:]:
            try:
                maps = Path(f"/proc/{pid}/maps").read_text()
            except OSError:
                continue
            for name in set(re.findall(r"/dev/shm/(\S+)", maps)):
                path = SHM_FOLDER / name
                if path.exists() and path.stat().st_size == BLOCK_BYTES:
                    return pid, name
        time.sleep(0.1)
    raise SystemExit("no view process")


class Stretches:
    """Stretches of one run, with the view and without it.

    Args:
        board: of the loop; pid: of the view process; page: in the browser; address: of the page.
    """

    def __init__(self, board: LoopBoard, pid: int, page: Tab, address: str) -> None:
        self._board, self._pid, self._page, self._address = board, pid, page, address

    def measure(self, watched: bool, seconds: float) -> LoopTiming:
        """What the loop counted in one."""
        if watched:
            os.kill(self._pid, signal.SIGCONT)
            self._page.open(self._address)
            self._page.wait_for("document.title.includes(': ')")
        else:
            self._page.open(EMPTY)
            os.kill(self._pid, signal.SIGSTOP)
        time.sleep(EDGE_S)
        before = self._board.timing()
        time.sleep(seconds)
        return self._board.timing().since(before)


def percentiles(timing: LoopTiming) -> dict[str, dict[str, float | None]]:
    """p50 and p99 of what is watched, µs."""
    return {
        what: {f"p{share:g}": timing.of(what).percentile_us(share) for share in SHARES}
        for what in WATCHED
    }


def added(parts: list[LoopTiming]) -> LoopTiming:
    """All that was counted in several stretches."""
    bins = sum(part.bins for part in parts)
    missed = sum(part.missed for part in parts), sum(part.missed_own for part in parts)
    return LoopTiming(np.asarray(bins), *missed)


def in_one_run(pairs: int, seconds: float) -> dict[str, Any]:
    """See the module."""
    found: dict[bool, list[LoopTiming]] = {True: [], False: []}
    with (
        tempfile.TemporaryDirectory() as folder,
        tab(Path(folder)) as page,
        live_run(Path(folder) / "run") as (run, address),
    ):
        pid, name = view_process(run)
        board = LoopBoard(SharedBlock.attach(name))
        page.open(address)
        page.wait_for("!!document.getElementById('clock')?.textContent", START_S)
        time.sleep(SETTLE_S)
        browser = family(page.pid)
        used, began = (processor_s([pid]), processor_s(browser)), time.monotonic()
        stretches = Stretches(board, pid, page, address)
        for k in range(pairs):
            for watched in (k % 2 == 0, k % 2 == 1):
                found[watched].append(stretches.measure(watched, seconds))
                print(f"pair {k + 1}, {'with' if watched else 'without'}", file=sys.stderr)
        os.kill(pid, signal.SIGCONT)
        wall_s = time.monotonic() - began
        cost = processor_s([pid]) - used[0], processor_s(browser) - used[1]
        board.close()
    ratios = {what: _ratios(found, what) for what in ("loop_us", "tick_us")}
    return {
        "pairs": pairs,
        "seconds_each": seconds,
        "without": percentiles(added(found[False])),
        "with": percentiles(added(found[True])),
        "missed_without": added(found[False]).missed,
        "missed_with": added(found[True]).missed,
        "p99_with_over_without": ratios,
        "view_processor_share_while_watched": cost[0] / (pairs * (seconds + EDGE_S)),
        "browser_processor_share_while_watched": cost[1] / (pairs * (seconds + EDGE_S)),
        "wall_s": wall_s,
    }


def _ratios(found: dict[bool, list[LoopTiming]], what: str) -> dict[str, Any]:
    """p99 with the view over p99 without, all together and pair by pair."""

    def p99(timing: LoopTiming) -> float:
        return timing.of(what).percentile_us(99.0) or np.nan

    pairs = [p99(a) / p99(b) for a, b in zip(found[True], found[False], strict=True)]
    spread = float(np.std(pairs, ddof=1) / np.sqrt(len(pairs))) if len(pairs) > 1 else None
    return {
        "all": p99(added(found[True])) / p99(added(found[False])),
        "median_of_pairs": float(np.median(pairs)),
        "standard_error": spread,
        "pairs": [round(x, 3) for x in pairs],
    }


def main() -> None:
    """Command line."""
    parser = options(__doc__)
    parser.add_argument("--pairs", type=int, default=8, help="of stretches in the run (default 8)")
    parser.add_argument("--seconds", type=float, default=8.0, help="of a stretch (default 8)")
    args = parser.parse_args()
    load = os.getloadavg()[0]
    told = {"load_before": load, "one_run": in_one_run(args.pairs, args.seconds)}
    told["load_after"] = os.getloadavg()[0]
    print(json.dumps(told, indent=1))
    write(args.json, told)


if __name__ == "__main__":
    main()
