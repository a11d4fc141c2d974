"""How far a learned arm's simulation is off, beside what the true model leaves: `make trials`.

An effect is hidden in an arm, found in one recording and simulated along another one of the same
arm, restarted from the data every 0.5 s, in every simulator; the same is done with the truth.
"""

from __future__ import annotations

import time
import traceback
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from gap_trials import SIMULATORS as MAKERS

from adapter.effects.catalogue import CATALOGUE
from adapter.gap.held_out import rms, rollout_errors
from adapter.gap.signals import Recorded
from adapter.gap.workflow import find_gap
from adapter.model.model_file import load_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.simulate import SIMULATORS, Rollouts
from drivers.files.mcap import Log
from tests.helpers.benchmark import in_processes, options, told
from tests.helpers.gap_oracle import second
from tests.hidden import Trial, draw


def true_model(trial: Trial) -> SelfModel:
    """The hidden arm as a self model."""
    entries = []
    for effect in trial.effects:
        entry = effect.as_dict()
        known = {p.key: 0.0 for p in CATALOGUE[effect.name].parameters if p.count == 1}
        entries.append({**entry, "parameters": {**known, **entry["parameters"]}})
    return replace(documented("panda"), theta=trial.arm.theta, effects=tuple(entries))


def errors(log: Log, truth: SelfModel, model: SelfModel, simulator: str) -> dict[str, Any]:
    """Position errors by joint (n,) mrad of the true and of the learned model along a recording."""
    simulate = Rollouts(simulator)
    off = rollout_errors(Recorded.of(log), truth, [model], simulate)
    true, ours = (1e3 * rms([x]) for x in (off.before_q, off.after_q))
    return {
        "true_mrad": true.tolist(),
        "ours_mrad": ours.tolist(),
        "ratio": float(np.sqrt(np.mean(np.square(ours)) / np.mean(np.square(true)))),
        "worst_ratio": float((ours / true).max()),
        "troubles": simulate.troubles,
    }


def run_trial(seed: int, effect: str, maker: str) -> dict[str, Any]:
    """Find the effect in one recording, simulate along another."""
    trial, begun = draw(seed, effect=effect, rubs=False), time.perf_counter()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.json"
        found = find_gap([MAKERS[maker](trial)], "panda", model_out=path)
        model = load_model(path)
    unseen = MAKERS[maker](second(trial))
    row: dict[str, Any] = {"seed": seed, "effect": effect, "maker": maker}
    row["found"] = [f"{f.effect}{list(f.joints)}" for f in found.findings]
    for name in SIMULATORS:
        row[name] = errors(unseen, true_model(trial), model, name)
    row["seconds"] = time.perf_counter() - begun
    return row


def _job(job: tuple[int, str, str]) -> dict[str, Any]:
    try:
        return run_trial(*job)
    except Exception:
        return {"seed": job[0], "effect": job[1], "failed": traceback.format_exc()}


def lines_of(row: dict[str, Any]) -> str:
    """A few lines of a trial."""
    if "failed" in row:
        return f"{row['effect']} {row['seed']}: failed\n{row['failed']}"
    lines = [f"{row['effect']} {row['seed']} -> {row['found']} ({row['seconds']:.0f} s)"]
    for name in SIMULATORS:
        own = row[name]
        ours, true = (" ".join(f"{x:.1f}" for x in own[k]) for k in ("ours_mrad", "true_mrad"))
        ratios = f"{own['ratio']:.3f}, worst joint {own['worst_ratio']:.2f}"
        lines.append(f"  {name}: {ours} mrad against {true}: {ratios}")
    return "\n".join(lines)


def main() -> None:
    """Run the trials asked for."""
    parser = options(__doc__, first=0, jobs=2)
    parser.add_argument("--effects", nargs="+", default=list(CATALOGUE), choices=list(CATALOGUE))
    parser.add_argument("--trials", type=int, default=3, help="seeds of each effect")
    parser.add_argument("--maker", choices=sorted(MAKERS), default="mujoco")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.trials)
    jobs = [(seed, effect, asked.maker) for effect in asked.effects for seed in seeds]
    rows = told(in_processes(_job, jobs, asked.jobs), asked.json, lines_of)
    done = [row for row in rows if "failed" not in row]
    for name in SIMULATORS:
        ratios = np.array([row[name]["ratio"] for row in done])
        within = f"{int((ratios <= 1.1).sum())} of {len(rows)} within 1.1 of the truth's error"
        print(f"{name}: {within}, median {np.median(ratios):.3f}, worst {ratios.max():.3f}")


if __name__ == "__main__":
    main()
