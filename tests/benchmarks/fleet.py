"""What a fleet costs: processes against each other, the same work elsewhere, and a plan from it.

The same normal equations are made by a plain loop over Pinocchio's regressor; `mujoco.sysid` (extra
`mujoco[sysid]`) fits the same parameters by simulating the recording over and over. The plan takes
what a recording costs here and simulates a fleet of machines that do hours of them, with stragglers
and machines that fail, and one process that keeps all results. `make bench`.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.robots import documented, robot_urdf
from adapter.effects.torque import ModelTorque
from adapter.experiments.rivals import of_this_process, sysid
from adapter.runs.fleet.fleet import Settings, found_logs, here, learn_fleet
from adapter.runs.fleet.moments import Task, content_of
from adapter.signals.validation import smooth
from drivers.files.mcap import McapWriter, read_log
from tests.helpers.benchmark import options, write

SEED = 11
NOISE = 1e-5, 1e-3, 0.05  # rad, rad/s, N m
FAILS_AN_HOUR, AWAY_S = 0.01, 600.0  # chance of a machine, and how long it is away then
SLOW_SHARE, SLOW = 0.05, 4.0  # stragglers, and how many times longer they take
SYSID_ROUNDS = 5  # of its optimizer


def make_logs(folder: Path, count: int, seconds: float) -> list[str]:
    """Recordings of different motions; those of before are kept."""
    from tests.helpers.arm_data import Motion, trajectory  # brings what no worker needs

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


def timed(logs: list[str], folder: Path, workers: int) -> tuple[float, float]:
    """Wall time and this process's processor time, s, of a fleet that knows nothing yet."""
    shutil.rmtree(folder, ignore_errors=True)
    started, own = time.perf_counter(), time.process_time()
    found = learn_fleet(logs, documented("panda"), Settings(folder, workers))
    if found.broken or found.read != len(logs):
        raise SystemExit(f"{len(found.broken)} broken of {len(logs)}")
    return time.perf_counter() - started, time.process_time() - own


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


def mujoco_sysid(logs: list[str]) -> dict[str, float]:
    """The same parameters by `mujoco.sysid`: ten of each link, damping and dry friction."""
    read, joints = map(read_log, logs), range(7)
    free = dict.fromkeys(("bodies", "viscous_friction", "coulomb_friction"), joints)
    signals = [(log.q, log.dq, log.tau) for log in read]
    found, (before, after) = sysid(documented("panda"), signals, free, SYSID_ROUNDS)
    damping = next(e for e in found.effects if e["effect"] == "viscous_friction")["parameters"]
    return {"residual_before": before, "after": after, "damping": float(np.median(damping["Fv"]))}


def in_a_process(arguments: list[str]) -> dict[str, Any]:
    """Wall and processor time, s, and most memory, MB, of this file in a process of its own."""
    started = time.perf_counter()
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return {"cannot": done.stderr.splitlines()[-1]}
    own = json.loads(done.stdout.splitlines()[-1])
    return {"wall_s": time.perf_counter() - started, **own}


def schedule(tasks: int, task_s: float, head_s: float, machines: int) -> dict[str, float]:
    """Hours until all tasks are done by machines of two processes and one that keeps results.

    Args:
        tasks: how many; task_s: of one on a process; head_s: of one where results are kept.
        machines: some of whose tasks take longer, and which fail with both tasks and come back.
    """
    rng = np.random.default_rng(SEED)
    free = [(0.0, machine) for machine in range(machines) for _ in range(2)]
    back_s, kept_s, lost, left = np.zeros(machines), 0.0, 0, tasks
    while left:
        at_s, machine = heapq.heappop(free)
        at_s = max(at_s, back_s[machine])
        took = task_s * (SLOW if rng.random() < SLOW_SHARE else 1.0)
        if rng.random() < 0.5 * FAILS_AN_HOUR * took / 3600.0:
            lost += 1  # the task goes back to the others
            back_s[machine] = at_s + took + AWAY_S
            heapq.heappush(free, (back_s[machine], machine))
            continue
        left -= 1
        kept_s = max(kept_s, at_s + took) + head_s
        heapq.heappush(free, (at_s + took, machine))
    ideal_s = tasks * task_s * (1.0 + SLOW_SHARE * (SLOW - 1.0)) / (2 * machines)
    read_s = max(at_s for at_s, _ in free)
    hours = {"read_hours": read_s / 3600.0, "kept_hours": kept_s / 3600.0}
    return {**hours, "read_over_ideal": read_s / ideal_s, "failures": lost}


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
    about, folder = __doc__.splitlines()[0], Path("runs/bench_fleet")
    many = {"logs": 200, "plan_hours": 10_000.0, "machines": 100}
    parser = options(about, seconds=20.0, folder=folder, **many)
    add = parser.add_argument
    add("--compared", type=int, default=20, help="logs of the comparison with other tools")
    add("--simulated", type=int, default=1, help="logs of that with mujoco.sysid")
    add("--only", choices=("fleet", "plain", "sysid"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    logs = make_logs(args.folder / "logs", args.logs, args.seconds)
    if args.only is not None:  # one way of doing the work, in this process
        some, told = logs[: args.compared], {}
        if args.only == "sysid":
            told = mujoco_sysid(some)
        elif args.only == "plain":
            plain_loop(some)
        else:
            timed(some, args.folder / "only", 0)
        print(json.dumps({**of_this_process(), **told}))
        return
    timed(logs[:2], args.folder / "first", 2)  # kernels are compiled
    found: dict[str, Any] = {"logs": len(logs), "seconds": args.seconds}
    for workers in (1, 2):
        found[f"workers_{workers}_s"], own_s = timed(logs, args.folder / f"out{workers}", workers)
    found["times_faster"] = found["workers_1_s"] / found["workers_2_s"]
    started = time.perf_counter()
    learn_fleet(logs, documented("panda"), Settings(args.folder / "out2", 2))
    found["again_s"] = time.perf_counter() - started
    found["overhead_ms_per_log"] = overhead_ms()
    same = ["--logs", str(args.logs), "--seconds", str(args.seconds), "--folder", str(args.folder)]
    for name, count in (("fleet", args.compared), ("plain", args.compared), ("fleet", 1)):
        told = in_a_process([*same, "--compared", str(count), "--only", name])
        found[f"{count}_logs_{name}"] = told
    several = ["--compared", str(args.simulated), "--only", "sysid"]
    found[f"{args.simulated}_logs_sysid"] = in_a_process([*same, *several])
    per_log_s = 2.0 * found["workers_2_s"] / len(logs)
    tasks = round(args.plan_hours * 3600.0 / args.seconds)
    head_s = own_s / len(logs)
    found["plan"] = {
        "hours_of_logs": args.plan_hours,
        "machines": args.machines,
        "s_per_log": per_log_s,
        "head_s_per_log": head_s,
        **schedule(tasks, per_log_s, head_s, args.machines),
    }
    print(json.dumps(found, indent=1))
    write(args.json, found)


if __name__ == "__main__":
    main()
