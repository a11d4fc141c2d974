"""What long logs cost: wall time, processor time and the most memory, by length and command.

    python tests/benchmarks/long_logs.py [--seconds 60 300 600] [--every 1 50] [--gap] [--hidden]
        [--json FILE]

A log is the documented Panda on a periodic motion of three sines a joint, with viscous and dry
friction and the sensors' noise (seed 7), written once as MCAP below `--folder`. With `--hidden`
the hand picks up 1 kg after two thirds of the time, something pushes it for 3 s after one third,
and the friction of joint 3 rises by 0.3 N m over the whole. Each command runs
in a process of its own on one thread, numba's kernels compiled before. Processor time is the fair
figure where a machine is shared.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.torque import ModelTorque
from adapter.model.inertia import theta_from_body
from adapter.model.robots import documented
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import McapWriter

RATE_HZ = 1000
PERIOD_S = 20.0  # of the motion
SINES = (2, 5, 11)  # cycles in it
AMPLITUDE = 0.25  # rad, of the slowest sine; the others by their frequency less
CENTRE = (0.0, -0.6, 0.0, -1.9, 0.0, 1.7, 0.7)  # rad, middle of the Panda's ranges
VISCOUS, DRY = 0.3, 0.6  # N m s/rad, N m
NOISE = (1e-5, 1e-3, 0.02)  # rad, rad/s, N m
SEED = 7
LOAD_KG, LOAD_AT_M, LOAD_SIZE = 1.0, (0.0, 0.0, 0.2), 2e-3  # in the last link's axes; kg m²
PUSH_N, PUSH_LASTS_S = (0.0, 15.0, 0.0), 3.0
DRIFTING, RISES_NM = 2, 0.3  # joint (from 0), N m over the whole recording
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Hidden:
    """What happens in a recording of so many seconds besides friction."""

    seconds: float

    @property
    def picked_up_s(self) -> float:
        """When the hand picks up LOAD_KG."""
        return round(2.0 * self.seconds / 3.0, 1) + 0.03

    @property
    def pushed_s(self) -> float:
        """When PUSH_N begins to act on the hand, for PUSH_LASTS_S."""
        return round(self.seconds / 3.0, 1) + 0.21

    @property
    def drift(self) -> float:
        """By how much the friction of joint DRIFTING rises, N m/s."""
        return RISES_NM / self.seconds


def one_period() -> tuple[Array, Array, Array]:
    """q, dq, tau (m, 7) of one period without noise."""
    q, dq, ddq = motion()
    tau = ModelTorque(documented("panda"))(q, dq, ddq)
    return q, dq, tau + VISCOUS * dq + DRY * rubs(dq)


def rubs(dq: Array) -> Array:
    """Direction (m, 7) of dry friction."""
    return np.asarray(np.tanh(dq / 0.01))


def motion() -> tuple[Array, Array, Array]:
    """q, dq, ddq (m, 7) of one period."""
    rng = np.random.default_rng(SEED)
    t = np.arange(round(PERIOD_S * RATE_HZ)) / RATE_HZ
    q = np.tile(np.array(CENTRE), (len(t), 1))
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    for cycles in SINES:
        w = 2.0 * np.pi * cycles / PERIOD_S
        size = AMPLITUDE * SINES[0] / cycles * rng.uniform(0.6, 1.0, 7)
        phase = w * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, 7)
        q += size * np.sin(phase)
        dq += size * w * np.cos(phase)
        ddq -= size * w**2 * np.sin(phase)
    return q, dq, ddq


def extra_torque() -> tuple[Array, Array]:
    """(m, 7) N m of the load and of the push, along one period."""
    q, dq, ddq = motion()
    model = documented("panda")
    theta = model.theta.copy()
    theta[-1] += theta_from_body(LOAD_KG, LOAD_AT_M, LOAD_SIZE * np.eye(3))
    loaded = ModelTorque(replace(model, theta=theta))(q, dq, ddq)
    arm = RigidArm.of(model)
    push = arm.wrench_torque(q, np.array([*PUSH_N, 0.0, 0.0, 0.0]))
    return loaded - ModelTorque(model)(q, dq, ddq), -push


def samples(seconds: float, hidden: Hidden | None = None) -> Iterator[tuple[Array, ...]]:
    """t, q, dq, tau of a recording of so many seconds, period by period."""
    tables, rng = one_period(), np.random.default_rng(SEED)
    load, push = extra_torque()
    for first in range(0, round(seconds * RATE_HZ), len(load)):
        rows = min(len(load), round(seconds * RATE_HZ) - first)
        t = (first + np.arange(rows)) / RATE_HZ
        q, dq, tau = (
            x[:rows] + s * rng.standard_normal((rows, 7))
            for x, s in zip(tables, NOISE, strict=True)
        )
        if hidden is not None:
            tau[t >= hidden.picked_up_s] += load[:rows][t >= hidden.picked_up_s]
            pushed = (t >= hidden.pushed_s) & (t < hidden.pushed_s + PUSH_LASTS_S)
            tau[pushed] += push[:rows][pushed]
            tau[:, DRIFTING] += hidden.drift * t * rubs(tables[1][:rows, DRIFTING])
        yield t, q, dq, tau


def write_log(path: Path, seconds: float, hidden: Hidden | None = None) -> None:
    """A recording of so many seconds."""
    names = documented("panda").tree.joint_names
    part = path.with_suffix(".part")
    with McapWriter(part, names, flush_s=60.0, overwrite=True) as writer:
        for t, *signals in samples(seconds, hidden):
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
        found["gap"] = [*adapter, "gap", str(log), "--model", "panda", "--out", out, "--quiet"]
    return found


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, nargs="+", default=[60, 300, 600])
    parser.add_argument("--every", type=int, nargs="*", default=[1, 50])
    parser.add_argument("--gap", action="store_true", help="measure gap too")
    parser.add_argument("--hidden", action="store_true", help="in recordings that hold more")
    parser.add_argument("--folder", type=Path, default=Path("/tmp/w/long_logs"))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seconds in args.seconds:
        log = args.folder / f"panda_{seconds}s{'_hidden' * args.hidden}.mcap"
        if not log.exists():
            write_log(log, seconds, Hidden(seconds) if args.hidden else None)
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
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
