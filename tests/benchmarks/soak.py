"""Long live runs with an eye on memory and on the account of samples: `make soak`.

Runs `adapter run` on a simulated arm, in this process's child (`pybullet`) or behind its wire
protocol in a process of its own (`fci`, `can`), with faults where asked, reads the resident memory
of all processes of the run every five seconds, and prints the growth after the first minute, the
account of every sample and the run's own figures.
"""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.helpers.benchmark import options, write

EVERY_S, SETTLED_S = 5.0, 60.0
SHORTEST_S = 30.0  # of a run that is begun again
EXIT_ARM = 3  # of `adapter run`: the arm failed, or tripped because the machine was away
READY_S = 120.0
# Faults of the wire, of either simulated arm, that come as a share of the messages.
FAULTS = ("drop", "late", "repeat", "reorder", "corrupt")
READY = {"fci": re.compile(r"127\.0\.0\.1:\d+"), "can": re.compile(r"can://\S+")}


def resident_kb(pid: int) -> int:
    """Private resident memory of a process; shared memory counts once, with its owner."""
    try:
        fields = dict(
            line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        )
    except OSError:
        return 0
    return int(fields["RssAnon"].split()[0]) if "RssAnon" in fields else 0


def family(pid: int) -> list[int]:
    """A process and all below it."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(member for child in children for member in family(int(child)))]


@contextlib.contextmanager
def simulated(arm: str, share: float, folder: Path) -> Iterator[tuple[str, Path]]:
    """A served arm with faults; gives its driver address and where its summary will be."""
    summary = folder / "arm.json"
    command = [sys.executable, "-u", "-m", "adapter", "sim", arm, "--json", str(summary)]
    command += ["--port", "0"] if arm == "fci" else []
    if share:
        for name in FAULTS:
            command += ["--fault", f"{name}={share}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = None
            deadline = time.monotonic() + READY_S
            while address is None and time.monotonic() < deadline:
                line = server.stdout.readline()
                found = READY[arm].search(line)
                if found is not None:
                    address = found.group(0) if arm == "can" else f"fci://{found.group(0)}"
                if not line:
                    break
            if address is None:
                raise SystemExit(f"the simulated {arm} arm did not start")
            yield address, summary
        finally:
            server.terminate()
            server.wait(READY_S)


def watch(command: list[str]) -> tuple[int, list[tuple[float, int]], float]:
    """Run a command; its exit code, (seconds, private memory in kB) of its family, its end."""
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=sys.stderr)
    memory: list[tuple[float, int]] = []
    while process.poll() is None:
        time.sleep(EVERY_S)
        now = time.monotonic() - began
        memory.append((now, sum(resident_kb(pid) for pid in family(process.pid))))
    return process.returncode, memory, time.monotonic() - began


def account(figures: dict[str, Any]) -> dict[str, Any]:
    """Where every message and every sample went, and whether the sums agree."""
    refused = sum(figures["refused"].values())
    intake = figures["intake"]
    return {
        "intake": intake,
        "messages_balance": intake["received"] == intake["used"] + sum(intake["refused"].values()),
        "samples_balance": figures["samples"] == figures["learned"] + refused,
        "all_recorded": figures["recorded"] == figures["samples"] and not figures["unrecorded"],
    }


def one_run(address: str, minutes: float, folder: Path) -> tuple[int, dict[str, Any]]:
    """One run until its end; the exit code and what it came to."""
    path = folder / "figures.json"
    command = [sys.executable, "-m", "adapter", "run", "--driver", address, "--allow-motion"]
    command += ["--robot", "panda", "--yes"]
    command += ["--duration", str(60 * minutes), "--seed", "5", "--quiet"]
    command += ["--out", str(folder), "--no-report", "--json", str(path)]
    code, memory, ended_s = watch(command)
    if code not in (0, EXIT_ARM):
        sys.exit(code)
    figures = json.loads(path.read_text())
    steady = [(t, kb) for t, kb in memory if SETTLED_S + 10 < t < ended_s - EVERY_S]
    shown = ["samples", "learned", "refused", "missed_deadlines", "recorded", "unrecorded"]
    shown += ["tick_us", "timing", "ended", "fault", "restarts"]
    return code, {
        "seconds": ended_s,
        "memory_mb": steady[-1][1] / 1024 if steady else None,
        "growth_after_first_minute_mb": (steady[-1][1] - steady[0][1]) / 1024 if steady else None,
        "recording_mb": sum(file.stat().st_size for file in folder.glob("*.mcap")) / 1e6,
        **account(figures),
        **{key: figures[key] for key in shown},
        "lambda_converged_s": figures["lambda"]["converged_s"],
        "theta_converged_s": figures["theta"]["converged_s"],
    }


def main() -> None:
    """Run, watch, print. An arm that tripped is run again until the time is over."""
    parser = options(__doc__, minutes=10.0, faults=0.0)
    parser.add_argument("--driver", choices=("pybullet", "fci", "can"), default="pybullet")
    args = parser.parse_args()
    found: dict[str, Any] = {"driver": args.driver, "faults": args.faults, "runs": []}
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        address, summary = "pybullet:panda", None
        if args.driver != "pybullet":
            address, summary = stack.enter_context(simulated(args.driver, args.faults, folder))
        if args.driver == "fci":
            address += "?recover=1"
        end = time.monotonic() + 60 * args.minutes
        while (left_s := end - time.monotonic()) > SHORTEST_S or not found["runs"]:
            _, run = one_run(address, left_s / 60, folder)
            found["runs"].append(run)
            print(json.dumps(run, indent=1), flush=True)
        stack.close()
        found["arm"] = None if summary is None else json.loads(summary.read_text())
    found["trips"] = [run["fault"] for run in found["runs"] if run["fault"]]
    print(json.dumps(found, indent=1))
    write(args.json, found)


if __name__ == "__main__":
    main()
