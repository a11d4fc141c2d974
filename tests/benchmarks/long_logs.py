"""What long logs cost: wall time, processor time and the most memory, by length and command.

    python tests/benchmarks/long_logs.py [--seconds 60 300 600] [--every 1 50] [--gap] [--hidden]
        [--holds] [--seed 7] [--json FILE]

A log is that of `tests.helpers.long_arm`, written once as MCAP below `--folder`; what `gap` says of
the changes that `--hidden` puts in is printed beside the truth. Each command runs in a process of
its own on one thread, kernels compiled before; on a shared machine processor time is the fair one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from adapter.model.robots import documented
from drivers.files.mcap import McapWriter
from tests.helpers.benchmark import options, write
from tests.helpers.long_arm import LOAD_KG, PUSH_LASTS_S, PUSH_N, RATE_HZ, SEED, Hidden, samples

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def write_log(path: Path, seconds: float, hidden: Hidden | None, seed: int) -> None:
    """A recording of so many seconds."""
    names = documented("panda").tree.joint_names
    part = path.with_suffix(".part")
    with McapWriter(part, names, flush_s=60.0, overwrite=True) as writer:
        for t, *signals in samples(seconds, hidden, seed=seed):
            for stamp_s, *row in zip(t, *signals, strict=True):
                writer.write_joint_state(round(1e9 * stamp_s) + 10**9 // RATE_HZ, *row)
    part.rename(path)


def measured(command: list[str]) -> dict[str, Any]:
    """Wall and processor time, s, and the most memory, MB, of a command."""
    environment = {**os.environ, **dict.fromkeys(ONE_THREAD, "1")}
    started = time.perf_counter()
    child = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    return {
        "exit": child.returncode,
        "wall_s": time.perf_counter() - started,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak_mb": used.ru_maxrss / 1024,
    }


def told(folder: Path, hidden: Hidden) -> dict[str, Any]:
    """What a gap says of what is hidden, and the truth behind it."""
    findings = json.loads((folder / "gap.json").read_text())["findings"]
    said = {
        f["effect"]: f
        for f in findings
        if f["effect"] in ("payload", "external_wrench", "friction_drift")
        and (f["effect"] != "payload" or f["interval_s"][0] > 0.0)
    }
    load, push, drift = (said.get(x) for x in ("payload", "external_wrench", "friction_drift"))
    sign = -1.0 if hidden.holds else 1.0
    out: dict[str, Any] = {"effects": sorted({f["effect"] for f in findings})}
    out["load kg"] = load and load["parameters"]["m"], sign * LOAD_KG
    out["at s"] = load and load["interval_s"][0], hidden.changed_s
    out["push N"] = push and push["parameters"]["fy"], PUSH_N[1]
    ends = hidden.pushed_s, hidden.pushed_s + PUSH_LASTS_S
    out["from, to s"] = push and push["interval_s"], ends
    out["drift N m/s"] = drift and drift["parameters"]["dFc"], hidden.drift
    return out


def commands(log: Path, every: list[int], folder: Path, gap: bool) -> dict[str, list[str]]:
    """What is measured of a log, by name."""
    adapter = [sys.executable, "-m", "adapter"]
    found = {"info": [*adapter, "info", str(log)]}
    for count in every:
        out = str(folder / f"out_{log.stem}_{count}_{time.time_ns()}")
        replay = [*adapter, "replay", str(log), "--robot", "panda", "--out", out, "--quiet"]
        found[f"replay --every {count}"] = [*replay, "--every", str(count)]
    if gap:
        out = str(folder / f"gap_{log.stem}_{time.time_ns()}")
        found["gap"] = [*adapter, "gap", str(log), "--robot", "panda", "--out", out, "--quiet"]
    return found


def main() -> None:
    """Measure what the command line names."""
    about = __doc__.splitlines()[0]
    parser = options(about, seed=SEED, folder=Path(tempfile.gettempdir()) / "long_logs")
    parser.add_argument("--seconds", type=int, nargs="+", default=[60, 300, 600])
    parser.add_argument("--every", type=int, nargs="*", default=[1, 50])
    parser.add_argument("--gap", action="store_true", help="measure gap too")
    parser.add_argument("--hidden", action="store_true", help="in recordings that hold more")
    parser.add_argument("--holds", action="store_true", help="the hand puts its load down")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seconds in args.seconds:
        kind = "_hidden" * args.hidden + "_holds" * args.holds
        log = args.folder / f"panda_{seconds}s{kind}_{args.seed}.mcap"
        hidden = Hidden(seconds, args.holds) if args.hidden else None
        if not log.exists():
            write_log(log, seconds, hidden, args.seed)
        for name, command in commands(log, args.every, args.folder, args.gap).items():
            row = {"seconds": seconds, "what": name, **measured(command)}
            row["times_real_time"] = seconds / row["cpu_s"]
            rows.append(row)
            print(
                f"{seconds:5d} s  {name:18s} exit {row['exit']}  wall {row['wall_s']:6.1f} s  "
                f"processor {row['cpu_s']:6.1f} s  {row['times_real_time']:6.1f} times real time  "
                f"{row['peak_mb']:5.0f} MB",
                flush=True,
            )
            if name == "gap" and hidden is not None:
                row["told"] = told(Path(command[command.index("--out") + 1]), hidden)
                for key, value in row["told"].items():
                    print(f"         {key}: {value}", flush=True)
    write(args.json, rows)


if __name__ == "__main__":
    main()
