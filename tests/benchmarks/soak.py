"""A long live run with an eye on its memory: `make soak`.

Runs `adapter run` on the simulated Panda, reads the resident memory of all its processes every
five seconds, and prints the growth after the first minute beside the run's own figures.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EVERY_S, SETTLED_S = 5.0, 60.0


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


def main() -> None:
    """Run, watch, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        figures_path = Path(name) / "figures.json"
        command = [sys.executable, "-m", "adapter", "run", "--driver", "pybullet:panda"]
        command += ["--duration", str(60 * args.minutes), "--seed", "5", "--quiet"]
        command += ["--out", name, "--no-report", "--json", str(figures_path)]
        began = time.monotonic()
        process = subprocess.Popen(command, stdout=sys.stderr)
        memory: list[tuple[float, dict[int, int]]] = []
        while process.poll() is None:
            time.sleep(EVERY_S)
            now = time.monotonic() - began
            memory.append((now, {pid: resident_kb(pid) for pid in family(process.pid)}))
        if process.returncode:
            sys.exit(process.returncode)
        figures = json.loads(figures_path.read_text())
        size = sum(path.stat().st_size for path in Path(name).glob("*.mcap"))
    end_s = began + 60 * args.minutes - began
    steady = [(t, sum(m.values())) for t, m in memory if SETTLED_S + 10 < t < end_s]
    growth_mb = (steady[-1][1] - steady[0][1]) / 1024 if steady else float("nan")
    found = {
        "minutes": args.minutes,
        "memory_mb": steady[-1][1] / 1024 if steady else None,
        "growth_after_first_minute_mb": growth_mb,
        "recording_mb": size / 1e6,
        **{key: figures[key] for key in ("samples", "learned", "refused", "missed_deadlines")},
        **{key: figures[key] for key in ("recorded", "unrecorded", "tick_us", "timing")},
    }
    text = json.dumps(found, indent=1)
    print(text)
    if args.json is not None:
        args.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
