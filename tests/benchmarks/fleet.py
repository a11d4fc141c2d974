"""What a fleet costs: processes against each other, the same work elsewhere, and a plan from it.

Recordings of `--seconds` hold the documented Panda's torques with friction and noise. The same
normal equations are made by a plain loop over Pinocchio's regressor with numpy. The plan takes what
a recording costs here and lets a fleet of machines do hours of them, with stragglers and processes
that die, by a simulation of the scheduler's rule: whoever is free takes the next. `make bench`.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.export import robot_urdf
from adapter.effects.robots import documented
from adapter.effects.torque import ModelTorque
from adapter.runs.fleet.engine import here
from adapter.runs.fleet.fleet import Settings, found_logs, learn_fleet
from adapter.runs.fleet.moments import Task, content_of
from adapter.signals.validation import smooth
from drivers.files.mcap import McapWriter, read_log
from tests.helpers.arm_data import Motion, trajectory

SEED = 11
NOISE = 1e-5, 1e-3, 0.05  # rad, rad/s, N m
DIES_AN_HOUR = 0.001  # chance of a process
SLOW_SHARE, SLOW = 0.05, 4.0  # stragglers, and how many times longer they take


def make_logs(folder: Path, count: int, seconds: float) -> list[str]:
    """Recordings of different motions; those of before are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    panda = documented("panda")
    torque, rng = ModelTorque(panda), np.random.default_rng(SEED)
    for k in range(count):
        path = folder / f"log{k:04d}.mcap"
        if path.exists():
            continue
        q, dq, ddq = trajectory(Motion(seconds, SEED + k))
        signals = q, dq, torque(q, dq, ddq) + 0.3 * dq + 0.4 * np.tanh(dq / 0.01)
        noise = [s * rng.standard_normal(q.shape) for s in NOISE]
        rows = zip(*(x + e for x, e in zip(signals, noise, strict=True)), strict=True)
        part = path.with_suffix(".part")
        with McapWriter(part, panda.tree.joint_names, flush_s=60.0, overwrite=True) as writer:
            for i, row in enumerate(rows, start=1):
                writer.write_joint_state(i * 10**6, *row)
        part.rename(path)
    return found_logs([str(folder)])[:count]


def timed(logs: list[str], folder: Path, workers: int) -> float:
    """Wall time, s, of a fleet that knows nothing yet."""
    shutil.rmtree(folder, ignore_errors=True)
    started = time.perf_counter()
    found = learn_fleet(logs, documented("panda"), Settings(folder, workers))
    if found.broken or found.read != len(logs):
        raise SystemExit(f"{len(found.broken)} broken of {len(logs)}")
    return time.perf_counter() - started


def plain_loop(logs: list[str]) -> None:
    """Normal equations of rigid body, friction and offsets by Pinocchio and numpy, and θ."""
    import pinocchio

    text = robot_urdf(documented("panda")).text
    whole = pinocchio.buildModelFromXML(text)
    fingers = [k for k in range(1, whole.njoints) if "finger" in whole.names[k]]
    model = pinocchio.buildReducedModel(whole, fingers, pinocchio.neutral(whole))
    data, n = model.createData(), model.nv
    A, b = 1e-6 * np.eye(13 * n), np.zeros(13 * n)
    for path in logs:
        log = read_log(path)
        at_s = 1e-9 * (log.stamp_ns - log.stamp_ns[0])
        for q, dq, ddq, tau in zip(*smooth(at_s, log.q, log.dq, log.tau), strict=True):
            Y = np.zeros((n, 13 * n))
            Y[:, : 10 * n] = pinocchio.computeJointTorqueRegressor(model, data, q, dq, ddq)
            for k, column in enumerate((dq, np.tanh(dq / 0.02), np.ones_like(dq)), start=10):
                Y[:, k * n : (k + 1) * n] = np.diag(column)
            A += Y.T @ Y
            b += Y.T @ tau
    np.linalg.solve(A, b)


def in_a_process(arguments: list[str]) -> dict[str, float]:
    """Wall and processor time, s, and most memory, MB, of this file in a process of its own."""
    started = time.perf_counter()
    command = [sys.executable, __file__, *arguments]
    told = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    own = json.loads(told.splitlines()[-1])
    return {"wall_s": time.perf_counter() - started, **own}


def of_this_process() -> dict[str, float]:
    """Processor time, s, and most memory, MB, so far."""
    peak = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return {"cpu_s": time.process_time(), "peak_mb": int(peak[1]) / 1024 if peak else math.nan}


def schedule(tasks: int, task_s: float, processes: int) -> dict[str, float]:
    """Hours until all tasks are done where some take longer and processes die with their task.

    A process that dies is gone for good; its task starts again elsewhere.
    """
    rng = np.random.default_rng(SEED)
    free = [(0.0, k) for k in range(processes)]
    end_s, lost, left = 0.0, 0, tasks
    while left:
        at, who = heapq.heappop(free)
        took = task_s * (SLOW if rng.random() < SLOW_SHARE else 1.0)
        if len(free) > 1 and rng.random() < DIES_AN_HOUR * took / 3600.0:
            lost += 1
            continue
        left, end_s = left - 1, max(end_s, at + took)
        heapq.heappush(free, (at + took, who))
    ideal_s = tasks * task_s * (1.0 + SLOW_SHARE * (SLOW - 1.0)) / processes
    return {"hours": end_s / 3600.0, "over_ideal": end_s / ideal_s, "processes_lost": lost}


def overhead_ms() -> float:
    """Of a task that is refused at once, sent through two processes."""
    spent = []
    for count in (20, 220):
        tasks = [Task(f"/nonexistent/{k}", "x" * 20_000) for k in range(count)]
        started = time.perf_counter()
        if len(list(here(content_of, tasks, 2))) != count:
            raise SystemExit("tasks were lost")
        spent.append(time.perf_counter() - started)
    return 1e3 * (spent[1] - spent[0]) / 200


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--logs", type=int, default=200)
    add("--seconds", type=float, default=20.0)
    add("--folder", type=Path, default=Path("runs/bench_fleet"))
    add("--plan-hours", type=float, default=10_000.0)
    add("--machines", type=int, default=100)
    add("--compared", type=int, default=20, help="logs of the comparison with other tools")
    add("--only", choices=("fleet", "plain"), help=argparse.SUPPRESS)
    add("--json", type=Path)
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    logs = make_logs(args.folder / "logs", args.logs, args.seconds)
    if args.only is not None:
        few = logs[: args.compared]
        plain_loop(few) if args.only == "plain" else timed(few, args.folder / "only", 0)
        print(json.dumps(of_this_process()))
        return
    timed(logs[:2], args.folder / "first", 2)  # kernels are compiled
    found: dict[str, Any] = {"logs": len(logs), "seconds": args.seconds}
    for workers in (1, 2):
        found[f"workers_{workers}_s"] = timed(logs, args.folder / f"out{workers}", workers)
    found["times_faster"] = found["workers_1_s"] / found["workers_2_s"]
    started = time.perf_counter()
    learn_fleet(logs, documented("panda"), Settings(args.folder / "out2", 2))
    found["again_s"] = time.perf_counter() - started
    found["overhead_ms_per_log"] = overhead_ms()
    same = ["--logs", str(args.logs), "--seconds", str(args.seconds), "--folder", str(args.folder)]
    same += ["--compared", str(args.compared)]
    for name in ("fleet", "plain"):
        found[f"{args.compared}_logs_{name}"] = in_a_process([*same, "--only", name])
    per_log_s = found["workers_1_s"] / len(logs)
    tasks = round(args.plan_hours * 3600.0 / args.seconds)
    found["plan"] = {
        "hours_of_logs": args.plan_hours,
        "machines": args.machines,
        "s_per_log": per_log_s,
        **schedule(tasks, per_log_s, 2 * args.machines),
    }
    text = json.dumps(found, indent=1)
    print(text)
    if args.json is not None:
        args.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
