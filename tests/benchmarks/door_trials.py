"""Twins of real logs at every door: how far `load`, `replay`, `gap` and `fleet` are apart.

    PYTHONPATH=. python tests/benchmarks/door_trials.py --first 6300 --trials 20

Near are two within 2 joint standard deviations, the truth within 3; odd seeds are MuJoCo's.
"""

from __future__ import annotations

import tempfile
from itertools import combinations
from pathlib import Path

import numpy as np

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.robots import read_robot
from adapter.gap.load import find_load
from adapter.gap.workflow import find_gap
from adapter.learning.settings import LearnerSettings
from adapter.model.model_file import load_model
from adapter.runs.config import PipelineSettings
from adapter.runs.fleet.fleet import Settings, learn_fleet
from adapter.runs.outcome import learned_model
from adapter.runs.replay import fitted_to, replay
from drivers.files.mcap import read_log
from tests.helpers.benchmark import Row, in_processes, options, share_of, told
from tests.helpers.twin_makers import by_mujoco, by_pinocchio
from tests.hidden.record import write_files
from tests.hidden.trial import nominal_urdf
from tests.hidden.twins import draw_twin
from tests.runs.test_doors import numbers

MASS = "mass", -1


def run(seed: int) -> Row:
    """One twin: pairs of doors, and doors and the truth: (what, joint, how far apart)."""
    twin, make = draw_twin(seed), by_mujoco if seed % 2 else by_pinocchio
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, file, _ = write_files(make(twin), nominal_urdf(twin.nominal), {}, folder)
        log, model, out = read_log(path), read_robot(str(file)), folder / "gap.json"
        load, own = find_load(log, model), fitted_to(log, PipelineSettings().filter)[0]
        settings = PipelineSettings(filter=own, learner=LearnerSettings(effects=REAL_ARM_EFFECTS))
        outcome = replay(log, model, settings).outcome
        found = find_gap([log], str(file), model_out=out).findings
        arm = learn_fleet([str(path)], model, Settings(folder / "fleet", workers=0)).arms[0]
        told_by = {"load": {MASS: (load.mass, load.mass_std)}}
        told_by["gap"] = numbers(load_model(out)) if out.exists() else {}
        masses = [(f.parameters["m"], f.std["m"]) for f in found if f.effect == "payload"]
    told_by["gap"] |= {MASS: masses[0]} if masses else {}
    both = ("replay", learned_model(outcome, model), outcome), ("fleet", arm.model, arm.outcome)
    for name, learned, ended in both:
        (mass, *_), C = ended.held
        told_by[name] = numbers(learned) | {MASS: (float(mass), float(np.sqrt(C[0, 0])))}
    rubs, true = twin.friction, {MASS: (twin.load_kg, 0.0)}
    for key, values in (("Fc", rubs.coulomb), ("Fv", rubs.viscous), ("o", twin.offset)):
        true |= {(key, j): (float(x), 0.0) for j, x in enumerate(values)}
    far: dict[str, list[tuple[str, int, float]]] = {}
    for (a, own_a), (b, own_b) in combinations((told_by | {"the truth": true}).items(), 2):
        for what in own_a.keys() & own_b.keys():
            (x, std), (y, other) = own_a[what], own_b[what]
            z = float(abs(x - y) / max(np.hypot(std, other), 1e-9))
            far.setdefault(f"{a} and {b}", []).append((*what, z))
    return {"seed": seed, "far": far}


def main() -> None:
    """Run the seeds asked for: a line each, then how many pairs are near."""
    args = options(__doc__, first=6300, trials=20, workers=2).parse_args()
    seeds = range(args.first, args.first + args.trials)
    rows = told(in_processes(run, seeds, args.workers), args.json)
    for pair in sorted({pair for row in rows for pair in row["far"]}):
        every = [z for row in rows for *_, z in row["far"].get(pair, ())]
        print(share_of(f"{pair} near", [z < (3.0 if "truth" in pair else 2.0) for z in every]))


if __name__ == "__main__":
    main()
