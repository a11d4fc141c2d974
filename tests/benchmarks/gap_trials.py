"""Hidden-effect trials of `adapter gap`: draw, record, find the gap, score. `make trials`.

The workflow sees a folder with the recording and the nominal model; the truth lies elsewhere
and is opened after it has answered.
"""

from __future__ import annotations

import json
import resource
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from adapter.gap.workflow import find_gap
from drivers.files.mcap import Log
from tests.helpers.benchmark import in_processes, options
from tests.helpers.gap_mujoco import mujoco_recording
from tests.helpers.gap_oracle import detectability, torque_judge
from tests.helpers.gap_scorer import Row, score_trial, summary, table
from tests.helpers.gap_tools import pinocchio_recording
from tests.hidden import Trial, draw
from tests.hidden.motion import KINDS
from tests.hidden.record import pybullet_recording, write

SIMULATORS: dict[str, Callable[[Trial], Log]] = {
    "pybullet": pybullet_recording,
    "mujoco": mujoco_recording,
    "pinocchio": pinocchio_recording,
}
BY_SEED = ("pinocchio", "mujoco")  # even seeds, odd seeds
Analyse = Callable[..., Any]
# Judges a result beyond its names: (trial, recording, result, its folder) -> figures for the row.
Judge = Callable[[Trial, Log, dict[str, Any], Path], Row]


def run_trial(trial: Trial, simulator: str, analyse: Analyse, judges: Sequence[Judge] = ()) -> Row:
    """Record, analyse as `find_gap` does and score one trial."""
    recording = SIMULATORS[simulator](trial)
    with tempfile.TemporaryDirectory() as folder:
        shown, kept = Path(folder) / "shown", Path(folder) / "kept"
        shown.mkdir()
        log, model, truth = write(trial, kept, recording, simulator)
        log, model = (path.rename(shown / path.name) for path in (log, model))
        begun = time.perf_counter()
        answer = analyse([log], model, model_out=shown / "model.json")
        seconds = time.perf_counter() - begun
        result: dict[str, Any] = answer if isinstance(answer, dict) else answer.as_dict()
        row = score_trial(result, json.loads(truth.read_text()), detectability(trial))
        for judge in judges:
            row.update(judge(trial, recording, result, shown))
    row["slow"], row["motion"], row["seconds"] = trial.motion.slow, trial.motion.kind, seconds
    row["simulator"], row["model_error"] = simulator, trial.model_error
    row["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    row["result"] = result
    return row


Job = tuple[int, str | None, str | None, str | None, bool, str | None, bool]


def _job(job: Job) -> Row:
    seed, kind, effect, simulator, judged, motion, sticks = job
    judges = (torque_judge,) if judged else ()
    maker = simulator or BY_SEED[seed % len(BY_SEED)]
    try:
        return run_trial(draw(seed, kind, effect, None, motion, sticks), maker, find_gap, judges)
    except Exception:
        return {"seed": seed, "failed": traceback.format_exc()}


def told(row: Row) -> str:
    """One line of a trial."""
    if "failed" in row:
        return f"{row['seed']}: failed\n{row['failed']}"
    truth = ", ".join(
        f"{name}{joints} z={z:.1f}"
        for (name, joints), z in zip(row["effects"], row["z"], strict=True)
    )
    found = ", ".join(f"{name}{joints}" for name, joints in row["found"])
    more = " + unexplained" if row["unexplained"] else ""
    mark = "WRONG " if row["wrong"] else ""
    said = f"{mark}{found or 'nothing'}{more} ({row['seconds']:.1f} s)"
    how = f"{row['simulator']}, {row['motion']}, {100 * row['model_error']:.1f} % off"
    rubs = " beside friction" if row["rubs"] else ""
    return f"{row['seed']}: {row['kind']}{rubs} ({how}) {truth} -> {said}"


def main() -> None:
    """Run the trials asked for."""
    parser = options(__doc__, trials=300, first=0, jobs=2)
    parser.add_argument("--simulator", choices=sorted(SIMULATORS), help="default: see BY_SEED")
    parser.add_argument("--kind", choices=("null", "single", "pair", "outside"))
    parser.add_argument("--effect", help="of all trials, instead of a drawn one")
    parser.add_argument("--motion", choices=KINDS, help="of all trials, instead of a drawn one")
    parser.add_argument("--sticks", action="store_true", help="Coulomb friction in every joint")
    parser.add_argument("--judge", action="store_true", help="torque error against the oracle's")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.trials)
    same = asked.kind, asked.effect, asked.simulator, asked.judge, asked.motion, asked.sticks
    jobs = [(seed, *same) for seed in seeds]
    rows = []
    for row in in_processes(_job, jobs, asked.jobs):
        rows.append(row)
        print(told(row), flush=True)
    done = [row for row in rows if "failed" not in row]
    figures = summary(done)
    figures["failed"] = len(rows) - len(done)
    print(table(figures))
    if figures["failed"]:
        print(f"{figures['failed']} trials failed")
    if asked.json:
        asked.json.write_text(json.dumps({"summary": figures, "rows": rows}, default=str) + "\n")


if __name__ == "__main__":
    main()
