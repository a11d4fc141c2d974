"""Twins of real logs, beside a plain weighted least squares: `make trials`.

    PYTHONPATH=. python tests/benchmarks/twin_trials.py --first 0 --trials 200 --json FILE

Even seeds are made by Pinocchio, odd ones by MuJoCo. True are a load above `NAMED_KG`, the last
link's other reading of it, and whatever friction, offset, delay and inertia of links are; all
other names are wrong.
"""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.gap.workflow import find_gap
from drivers.files.mcap import Log
from sim.truth import Truth
from tests.helpers.benchmark import Row, in_processes, options, share_of, told, with_columns
from tests.helpers.gap_effects import regressor, rnea
from tests.helpers.twin_makers import by_mujoco, by_pinocchio
from tests.hidden.record import write_files
from tests.hidden.trial import nominal_urdf
from tests.hidden.twins import draw_twin

TRUE = {
    "coulomb_friction",
    "viscous_friction",
    "asymmetric_friction",
    "stribeck_friction",
    "bristle_friction",
    "torque_offset",
    "torque_filter",
    "signal_delay",
    "link_inertia",
    "payload",
}
SURE_KG, NAMED_KG, RIGHT_KG, STDS = 0.5, 0.3, 0.1, 3.0
RATE_HZ, BAND_HZ, KEPT = 500.0, 8.0, 10  # of the even grid; of the low-pass; one row of so many
REST_WIDTH = 0.03  # rad/s: of friction's tanh
PRIOR_KG, PRIOR_KGM = 3.0, 0.3
PRIOR = np.array([PRIOR_KG, *[PRIOR_KGM] * 3, *[0.1] * 6])
ROUNDS = 5  # of the joints' weights


def weighed(recording: Log, nominal: Truth) -> float:
    """Mass kg of a load on the last link, friction and offsets of all joints learned beside it:
    what any user of numpy would try first."""
    t = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    grid = np.arange(t[0], t[-1], 1 / RATE_HZ)
    low = butter(2, BAND_HZ, fs=RATE_HZ, output="sos")
    q, tau = (
        sosfiltfilt(low, np.array([np.interp(grid, t, c) for c in x.T]).T, axis=0)
        for x in (recording.q, recording.tau)
    )
    dq = np.gradient(q, 1 / RATE_HZ, axis=0)
    ddq = np.gradient(dq, 1 / RATE_HZ, axis=0)
    inner = slice(int(0.05 * len(q)), int(0.95 * len(q)), KEPT)
    q, dq, ddq, tau = (x[inner] for x in (q, dq, ddq, tau))
    rest = tau - rnea(nominal, q, dq, ddq)
    n = rest.shape[1]
    load = regressor(nominal, q, dq, ddq)[:, :, -10:]
    columns = with_columns(load, (np.tanh(dq / REST_WIDTH), dq, np.ones_like(dq)))
    information = np.diag(np.concatenate([PRIOR**-2.0, np.ones(3 * n)]))
    weight, x = np.ones(n), np.zeros(10 + 3 * n)
    for _ in range(ROUNDS):
        A = information + np.einsum("mji,j,mjk->ik", columns, weight, columns)
        x = np.linalg.solve(A, np.einsum("mji,j,mj->i", columns, weight, rest))
        weight = 1 / np.maximum(np.square(rest - columns @ x).mean(axis=0), 1e-4)
    return float(x[0])


def run(seed: int) -> Row:
    """One twin: what `find_gap` says of it, and what least squares weighs."""
    twin = draw_twin(seed)
    recording = (by_mujoco if seed % 2 else by_pinocchio)(twin)
    row: Row = {**twin.as_dict(), "weighed_kg": weighed(recording, twin.nominal)}
    with tempfile.TemporaryDirectory() as folder:
        files = write_files(recording, nominal_urdf(twin.nominal), {}, Path(folder))
        begun = time.process_time()
        try:
            found = find_gap([files[0]], files[1]).as_dict()
        except Exception as error:
            return {**row, "refused": str(error) or traceback.format_exc()}
        row["processor_s"] = time.process_time() - begun
    findings = found["findings"]
    loads = [f for f in findings if f["effect"] == "payload"]
    row["names"] = [[f["effect"], f["joints"], f["evidence"]] for f in findings]
    if loads:
        row["mass_kg"] = loads[0]["parameters"]["m"]
        row["mass_std_kg"] = loads[0]["std"]["m"]
    return row


def judged(row: Row) -> Row:
    """What of a row is right."""
    names = {name for name, _, _ in row.get("names", [])}
    mass, std = row.get("mass_kg", 0.0), row.get("mass_std_kg", 0.0)
    off = abs(mass - row["load_kg"])
    return {
        "loaded": row["load_kg"] > SURE_KG,
        "bare": row["load_kg"] == 0.0,
        "named": "payload" in names,
        "right": "payload" in names and off < max(RIGHT_KG, STDS * std),
        "false_load": mass > NAMED_KG,
        "push": "external_wrench" in names,
        "wrong": bool(names - TRUE - {"external_wrench"}),
        "refused": "refused" in row,
    }


def summary(rows: list[Row]) -> list[str]:
    """The figures, each with its 95 % interval."""
    marks = [judged(row) for row in rows]
    loaded, bare = ([m for m in marks if m[key]] for key in ("loaded", "bare"))
    lines = [
        ("load named", [m["named"] for m in loaded]),
        ("its mass right", [m["right"] for m in loaded]),
        ("no load named on a bare arm", [not m["false_load"] for m in bare]),
        ("false push", [m["push"] for m in marks]),
        ("another wrong name", [m["wrong"] for m in marks]),
        ("refused", [m["refused"] for m in marks]),
    ]
    said = [share_of(*line) for line in lines]
    off = [abs(r["weighed_kg"] - r["load_kg"]) for r in rows]
    said.append(f"least squares is off by {np.median(off):.2f} kg (median), {max(off):.2f} at most")
    return said


def main() -> None:
    """Run the seeds asked for and print a line each."""
    args = options(__doc__, first=0, trials=200, workers=2).parse_args()
    seeds = range(args.first, args.first + args.trials)
    rows = told(
        in_processes(run, seeds, args.workers),
        args.json,
        lambda row: json.dumps({k: v for k, v in row.items() if k != "load_at"}),
    )
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
