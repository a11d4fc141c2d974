"""What `adapter replay` announces of arms that go from slow to fast, half of them point to point.

    PYTHONPATH=. python tests/benchmarks/live_trials.py --first 72000 --trials 100

Odd seeds are sines. By turns joints stick (Coulomb), have bristles (LuGre) or Stribeck's friction;
half of the arms pick up a load. Two of three logs are MuJoCo's, the others Pinocchio's.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sim.effects import Effect
from tests.helpers.benchmark import in_processes, options, told
from tests.helpers.gap_mujoco import mujoco_recording
from tests.helpers.gap_tools import pinocchio_recording
from tests.hidden import Trial, draw
from tests.hidden.motion import STEP_S, draw_motion
from tests.hidden.record import write
from tests.hidden.sizes import COULOMB, draw_bristles, draw_effect, torque_size

SECONDS, STREAM, SLOW, TURN_S = 40.0, 78, 0.3, 1.0
SLOW_UNTIL_S, LOAD_S, NEAR_S = (8.0, 15.0), (18.0, 32.0), 0.6


def trial_of(seed: int) -> Trial:
    """Slow motion first; friction in every joint; a load from some time on or none."""
    trial, rng = draw(seed, "null", rubs=False), np.random.default_rng([seed, STREAM])
    arm, n, law = trial.nominal, trial.nominal.n, seed // 2 % 3
    t = np.arange(0.0, SECONDS + TURN_S, STEP_S)
    fast = np.clip((t - rng.uniform(*SLOW_UNTIL_S)) / TURN_S, 0.0, 1.0)
    pace = STEP_S * np.cumsum(SLOW + (1.0 - SLOW) * fast)
    kind = "sines" if seed % 2 else "points"
    motion = draw_motion(rng, arm.limits, arm.ready, kind, pace)
    effects = []
    for j in range(1, n + 1) if law != 1 else ():
        Fc = torque_size(rng, j, COULOMB)
        more = {"Fs": 1.3 * Fc, "vs": 0.05} if law else {}
        name = "stribeck_friction" if law else "coulomb_friction"
        effects.append(Effect(name, (j,), {"Fc": Fc, **more}))
    friction = draw_bristles(rng, n) if law == 1 else None
    if seed // 6 % 2:
        load = draw_effect(rng, "payload", arm)
        effects.append(replace(load, interval_s=(float(rng.uniform(*LOAD_S)), None)))
    moved = trial.arm.with_changes(ready=motion.middle)
    return replace(
        trial, arm=moved, motion=motion, effects=tuple(effects), friction=friction, seconds=SECONDS
    )


def run(seed: int) -> dict[str, Any]:
    """One log: its load (s, kg) and how late it was seen, and all that is not true."""
    trial = trial_of(seed)
    recording = (mujoco_recording if seed % 3 else pinocchio_recording)(trial)
    loads = [(e.start_s, e.number("m")) for e in trial.effects if e.name == "payload"]
    with tempfile.TemporaryDirectory() as folder:
        log, model, _ = write(trial, Path(folder), recording, "live")
        figures = Path(folder) / "figures.json"
        command = [sys.executable, "-m", "adapter", "replay", log, "--robot", model, "--no-report"]
        command += ["--quiet", "--out", Path(folder) / "run", "--json", figures]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        if done.returncode not in (0, 9):  # 9: not converged
            return {"seed": seed, "failed": done.stderr}
        said = json.loads(figures.read_text("utf-8"))["disagreements"]
    late, false = None, []
    for entry in said:
        near = [abs(entry["since_s"] - start_s) < NEAR_S for start_s, _ in loads]
        if late is None and entry["what"] == "payload" and any(near):
            late = entry["reported_s"] - loads[0][0]
        else:
            false.append(entry["line"])
    return {"seed": seed, "kind": trial.motion.kind, "load": loads, "late_s": late, "false": false}


def main() -> None:
    """Run the trials asked for."""
    asked = options(__doc__, trials=100, first=0, jobs=2).parse_args()
    seeds = range(asked.first, asked.first + asked.trials)
    rows = told(in_processes(run, seeds, asked.jobs), asked.json)
    done = [row for row in rows if "failed" not in row]
    loads = [row for row in done if row["load"]]
    seen = [row["late_s"] for row in loads if row["late_s"] is not None]
    print(f"with a false announcement: {sum(bool(row['false']) for row in done)} of {len(done)}")
    print(f"loads seen: {len(seen)} of {len(loads)}, after {np.median(seen):.2f} s (median)")


if __name__ == "__main__":
    main()
