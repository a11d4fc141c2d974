"""One thing wrong with each log (`../shared/tools/odd_logs.py`): is it told? `make trials`.

    PYTHONPATH=. python tests/benchmarks/odd_trials.py gap --first 1
    PYTHONPATH=. python tests/benchmarks/odd_trials.py hidden --first 31000 --trials 100

At a door (`gap`, `load`, `learn`, `replay`) the 80 logs have the numbers of the log without the
flaw, or are refused, as their verdicts say. `hidden` puts a flaw that changes nothing into each of
many logs of one hidden effect: names and sizes are to be those that the log has without it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import adapter
from adapter.effects.robots import read_robot
from adapter.gap.load import find_load
from adapter.model.model_file import save_model
from adapter.model.self_model import SelfModel
from tests.helpers.benchmark import Row, in_processes, options, told
from tests.helpers.gap_mujoco import mujoco_recording
from tests.helpers.gap_tools import pinocchio_recording
from tests.hidden import draw, nominal_urdf

SHARED = Path(__file__).resolve().parents[3] / "shared"
STDS, TORQUE_NM, EVERY = 2.0, 0.1, 50
# What may be named beside the clean log's names, since it is so; whose own torque is lost
MORE = {"effort_late_by": "signal_delay", "table_off_by": "base_tilt"}
DEAD = {"effort_5_dead": 5, "effort_2_constant": 2}

Numbers = dict[tuple[Any, ...], tuple[float, float]]  # what -> value and standard deviation
Answer = Numbers | str  # or why there is none


def by_gap(log: adapter.Log, model: SelfModel) -> Numbers:
    """Parameters of what is named."""
    return {
        (f.effect, *f.joints, name): (value, f.std.get(name, 0.0))
        for f in adapter.find_gap(log, model).findings
        for name, value in f.parameters.items()
        if np.ndim(value) == 0
    }


def by_load(log: adapter.Log, model: SelfModel) -> Numbers:
    """The mass, kg."""
    found = find_load(log, model)
    return {("mass",): (found.mass, found.mass_std)}


def by_learn(log: adapter.Log, model: SelfModel) -> Numbers:
    """Torques of the model that was learned."""
    return torques(adapter.learn(log, model, every=EVERY).model, model)


def by_replay(log: adapter.Log, model: SelfModel) -> Numbers:
    """The same of the command."""
    with tempfile.TemporaryDirectory() as out:
        robot, how = str(save_model(model, f"{out}/arm.json")), ("--every", str(EVERY), "--quiet")
        asked = "replay", str(log.path), "--robot", robot, "--no-report", "--out", f"{out}/run"
        done = subprocess.run((sys.executable, "-m", "adapter", *asked, *how), capture_output=True)
        if done.returncode not in (0, 9):  # nine: what was not shown is the documentation's
            raise ValueError(done.stderr.decode())
        return torques(adapter.load_model(f"{out}/run/model.json"), model)


def torques(learned: SelfModel, model: SelfModel) -> Numbers:
    """Of a model that was learned, at some poses in motion, on a base that is level."""
    rng, learned = np.random.default_rng(0), replace(learned, gravity=model.gravity)
    q = rng.uniform(model.limits.lower, model.limits.upper, (50, len(model.limits.lower)))
    tau = adapter.inverse_dynamics(learned, q, rng.uniform(-0.5, 0.5, q.shape), 0.0 * q)
    off = TORQUE_NM / STDS / np.sqrt(2.0)
    return {("tau", k, j + 1): (x, off) for (k, j), x in np.ndenumerate(tau)}


DOORS: dict[str, Callable[[adapter.Log, SelfModel], Numbers]] = {
    "gap": by_gap,
    "load": by_load,
    "learn": by_learn,
    "replay": by_replay,
}


@cache
def answer(door: str, path: Path, urdf: Path) -> Answer:
    """What a door says of a log: numbers, or the sentence with which it refuses."""
    warnings.simplefilter("ignore")
    try:
        return DOORS[door](adapter.read_log(path), read_robot(str(urdf)))
    except ValueError as error:
        return str(error)


def differences(name: str, clean: Answer, odd: Answer) -> list[str]:
    """What a log with a flaw says otherwise; numbers by over `STDS` standard deviations of both."""
    if isinstance(clean, str) or isinstance(odd, str):
        return [] if isinstance(clean, str) else [f"refused: {odd}"]
    more = next((effect for flaw, effect in MORE.items() if flaw in name), None)
    dead = next((joint for flaw, joint in DEAD.items() if flaw in name), None)
    said = []
    for what in sorted(clean.keys() | odd.keys(), key=str):
        if what[0] == more or what[1:2] == (dead,) or what[2:3] == (dead,):
            continue
        (value, std), (other, own) = (x.get(what, (np.nan, 0.0)) for x in (clean, odd))
        if not abs(value - other) <= STDS * np.hypot(std, own):
            said.append(f"{what}: {other:.4g} +- {own:.2g} for {value:.4g} +- {std:.2g}")
    return said


def at_door(door: str, urdf: Path, folder: Path, job: tuple[str, str]) -> Row:
    """What is wrong with the answer to one of the 80 logs, of a name and a verdict."""
    (name, verdict), wrong = job, list[str]()
    odd = answer(door, folder / f"{name}.mcap", urdf)
    if verdict == "refuse":
        wrong = [] if isinstance(odd, str) else ["not refused"]
    elif not (verdict == "mend" and isinstance(odd, str) and "--" in odd):
        clean = answer(door, folder / f"{'loaded_' * name.startswith('loaded_')}base.mcap", urdf)
        wrong = differences(name, clean, odd)
    return {"log": name, "wrong": wrong}


def tool() -> Any:
    """`odd_logs.py`."""
    sys.path.insert(0, str(SHARED / "tools"))
    return import_module("odd_logs")


def hidden(seed: int) -> Row:
    """What a log of one hidden effect says otherwise once it has a flaw."""
    trial, rng, odd = draw(seed, "single"), np.random.default_rng([seed, 39]), tool()
    log = (mujoco_recording if seed % 2 else pinocchio_recording)(trial)
    signals = [x[::2] for x in (1e-9 * (log.stamp_ns - log.stamp_ns[0]), log.q, log.dq, log.tau)]
    cases = odd.cases((*signals, 0.0), list(log.joint_names))
    name = str(rng.choice([k for k, case in cases.items() if case[0] == "same"][1:]))
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.mcap" for k in ("base", name)]
        (urdf := Path(folder) / "arm.urdf").write_text(nominal_urdf(trial.nominal))
        for path in paths:
            odd.write(path, *cases[path.stem][1:])
        clean, flawed = (answer("gap", path, urdf) for path in paths)
    wrong = differences(name, clean, flawed)
    return {"seed": seed, "hidden": trial.effects[0].name, "flaw": name, "wrong": wrong}


def main() -> None:
    """Judge the logs asked for, a line each; --trials is of `hidden`."""
    parser = options(__doc__, first=1, trials=100, workers=2)
    parser.add_argument("door", choices=(*DOORS, "hidden"))
    args = parser.parse_args()
    run, jobs = hidden, list[Any](range(args.first, args.first + args.trials))
    with tempfile.TemporaryDirectory() as folder:
        if args.door != "hidden":
            odd, urdf = tool(), SHARED / "models" / "panda_gaz2019.urdf"
            recorded = odd.recorded  # of seeds 1 and 3
            odd.recorded = lambda arm, seed, *more: recorded(arm, seed + args.first - 1, *more)
            odd.main(folder, str(urdf))
            jobs = list(json.loads((Path(folder) / "verdicts.json").read_text()).items())
            run = partial(at_door, args.door, urdf, Path(folder))
        rows = told(in_processes(run, jobs, args.workers), args.json)
    print(f"right: {sum(not row['wrong'] for row in rows)} of {len(rows)}")


if __name__ == "__main__":
    main()
