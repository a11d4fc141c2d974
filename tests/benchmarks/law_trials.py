"""Laws of no catalogue, hidden: variables, form, coefficient, what is left. `make trials`.

Each trial adds one law to one joint of Pinocchio's arm (or MuJoCo's), beside no friction, that of
the catalogue in all joints or LuGre's, half of them point to point; `--none` adds none, `--quiet`
takes nine tenths of the disturbance away. Formulas are its own.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adapter.gap.workflow import find_gap
from tests.helpers.benchmark import Row, in_processes, options, share_of, told
from tests.helpers.gap_effects import rnea, sense
from tests.helpers.gap_mujoco import simulate
from tests.helpers.gap_tools import recorded
from tests.hidden import Trial, draw, nominal_urdf
from tests.hidden.record import write_files

Array = np.ndarray
SIZES_NM, WRIST_SHARE = (0.1, 1.0), 0.3  # rms of the law's torque; of joints 5 to 7
QUIET, FASTEST = 0.1, 6.0  # of the disturbance; rad/s


class Arm(NamedTuple):
    """Signals (m,) of the joint and of another, what draws settings, and the angles planned."""

    q: Array
    dq: Array
    tau: Array
    dq_other: Array
    tau_other: Array
    rng: np.random.Generator
    planned: Array

    @property
    def sign(self) -> Array:
        """Direction of the joint, which turns around 1 mrad/s."""
        return np.tanh(1e3 * self.dq)

    def edge(self) -> float:
        """An angle in the middle of those seen."""
        return float(np.quantile(self.planned, self.rng.uniform(0.25, 0.75)))


def _sine(at: Arm) -> Array:
    return np.sin(at.rng.integers(1, 4) * at.q + at.rng.uniform(-3.0, 3.0))


# Name of the law -> its torque per unit; ⱼ is another joint.
WITHIN: dict[str, Callable[[Arm], Array]] = {
    "dq |dq|": lambda at: at.dq * np.abs(at.dq),
    "dq³": lambda at: at.dq**3,
    "dq²": lambda at: at.dq**2,
    "sign(dq) |dq|^p": lambda at: at.sign * np.abs(at.dq) ** at.rng.uniform(1.3, 2.7),
    "(q - a)³": lambda at: (at.q - at.edge()) ** 3,
    "max(q - a, 0)": lambda at: np.maximum(at.q - at.edge(), 0.0),
    "max(a - q, 0)": lambda at: np.maximum(at.edge() - at.q, 0.0),
    "max(q - a, 0)²": lambda at: np.maximum(at.q - at.edge(), 0.0) ** 2,
    "sign(dq) sin(n q + phase)": lambda at: at.sign * _sine(at),
    "dq sin(n q + phase)": lambda at: at.dq * _sine(at),
    "sign(dq) max(q - a, 0)": lambda at: at.sign * np.maximum(at.q - at.edge(), 0.0),
    "dqⱼ": lambda at: at.dq_other,
    "dqⱼ |dqⱼ|": lambda at: at.dq_other * np.abs(at.dq_other),
    "tauⱼ": lambda at: at.tau_other,
    "tau²": lambda at: at.tau**2,
    "tau² sign(dq)": lambda at: at.sign * at.tau**2,
}
BEYOND: dict[str, Callable[[Arm], Array]] = {
    "exp(3 q)": lambda at: np.exp(3.0 * (at.q - at.planned.mean())),
    "dq / (1 + 9 dq²)": lambda at: at.dq / (1.0 + 9.0 * at.dq**2),
    "exp(-(q - a)² / 0.02)": lambda at: np.exp(-((at.q - at.edge()) ** 2) / 0.02),
    "sign(dq) exp(q)": lambda at: at.sign * np.exp(at.q),
    "cos(3 dq)": lambda at: np.cos(3.0 * at.dq),
    "q dq²": lambda at: at.q * at.dq**2,
}


class Job(NamedTuple):
    """A trial: its seed, whether no law is hidden, whose arm it is, whether little disturbs it."""

    seed: int
    none: bool = False
    simulator: str = "pinocchio"
    quiet: bool = False


def _trial(job: Job) -> tuple[Trial, str, dict[str, Any], tuple[Array, ...]]:
    """Drawn arm and motion, the law's name and what was drawn of it, readings with it."""
    seed, rng = job.seed, np.random.default_rng([job.seed, 777])
    friction = str(rng.choice(["none", "rubs", "sticks"]))
    motion = "points" if seed % 2 else "sines"
    trial = draw(seed, "null", None, friction != "none", motion, friction == "sticks")
    trial = replace(trial, disturbance_nm=trial.disturbance_nm * (QUIET if job.quiet else 1.0))
    path = trial.motion.at(trial.times)
    rigid, names = rnea(trial.arm, *path), [*WITHIN, *BEYOND]
    j, name = int(rng.integers(7)), names[seed // 2 % len(names)]
    other = int(rng.choice([k for k in range(7) if k != j]))
    drawn = int(rng.integers(2**32))

    def law(q: Array, dq: Array, tau: Array) -> Array:
        """Of signals (..., 7), always with the same settings."""
        signals = q[..., j], dq[..., j], tau[..., j], dq[..., other], tau[..., other]
        return (WITHIN | BEYOND)[name](Arm(*signals, np.random.default_rng(drawn), path[0][:, j]))

    size = np.exp(rng.uniform(*np.log(SIZES_NM))) * (WRIST_SHARE if j > 3 else 1.0)
    c = 0.0 if job.none else size / law(*path[:2], rigid).std()
    if job.simulator == "mujoco":
        more = np.eye(7)[j]
        q, dq, tau, _ = simulate(trial, lambda *signals: c * law(*signals) * more)
    else:
        rubs = trial.friction.along(path[1], 1e-3) if trial.friction else 0.0
        q, dq, tau = sense(trial.arm, trial.effects, trial.times, *path, rubs)
        tau[:, j] += c * law(*path[:2], rigid)
        tau += trial.disturbance()
    said = {"within": name in WITHIN, "friction": friction, "motion": motion}
    said |= {"size_nm": size, "c": c, "joint": j + 1}
    return trial, name.replace("ⱼ", str(other + 1)), said, (q, dq, tau)


def _variables(text: str, joint: int) -> set[str]:
    """Signals in a law, or in the names of some: of the joint itself without a number."""
    return {x.removesuffix(str(joint)) for x in re.findall(r"(?:ddq|dq|tau|q|t)\d*", text)} - {"t"}


def run(job: Job) -> Row:
    """One trial: what was hidden and what was said; nothing where the law threw the arm about."""
    trial, name, drawn, (q, dq, tau) = _trial(job)
    if not np.abs(dq).max() < FASTEST:
        return {}
    log = recorded(trial, q, dq, tau, None)
    with tempfile.TemporaryDirectory() as folder:
        paths = write_files(log, nominal_urdf(trial.nominal), {}, Path(folder))
        begun = time.process_time()
        result = find_gap([paths[0]], paths[1])
    j, laws = drawn["joint"], [f for f in result.findings if f.effect.startswith("law: ")]
    own = [f for f in laws if f.joints == (j,)]
    left = [x for x in result.unexplained if x.joint == j]
    said = [f.effect.removeprefix("law: ") for f in own] + [v for x in left for v in x.depends_on]
    right = [f for f in own if f.effect == f"law: {name}"]
    off = [(abs(f.parameters["c"] - drawn["c"]), f.std["c"]) for f in right]
    return {
        "seed": job.seed,
        "law": name,
        **drawn,
        "told": bool(own or left),
        "variables": _variables(" ".join(said), j) == _variables(name, j),
        "form": bool(right),
        "coefficient": any(error < max(3.0 * std, 0.05 * drawn["c"]) for error, std in off),
        "laws": [(f.effect, f.joints[0], f.parameters, f.std) for f in laws],
        "names": [(f.effect, list(f.joints)) for f in result.findings if f not in laws],
        "left": [(x.joint, list(x.depends_on)) for x in result.unexplained],
        "false": len(laws) - len(own),
        "over_floor": float(result.after.torque_rmse_nm[j - 1] / result.noise_floor_nm[j - 1]),
        "processor_s": time.process_time() - begun,
    }


def summary(rows: Sequence[Row]) -> list[str]:
    """Shares with their 95 % intervals."""
    within = [r for r in rows if r["within"] and r["c"]]
    lines = [
        ("told, by a law or what it follows", [r["told"] for r in rows if r["c"]]),
        ("right variables, of those told", [r["variables"] for r in rows if r["c"] and r["told"]]),
        ("within the grammar: right form", [r["form"] for r in within]),
        ("its coefficient, of those", [r["coefficient"] for r in within if r["form"]]),
        ("a law on another joint, or where none is", [r["false"] > 0 for r in rows]),
    ]
    said = [share_of(*line) for line in lines]
    over = np.quantile([r["over_floor"] for r in rows], [0.5, 0.9])
    return [*said, f"held out, over the noise: {over[0]:.2f} (median), {over[1]:.2f} (90 %)"]


def main() -> None:
    """Run the seeds asked for and print a line each."""
    parser = options(__doc__, first=0, trials=132, workers=2)
    parser.add_argument("--none", action="store_true", help="hide no law")
    parser.add_argument("--simulator", choices=("pinocchio", "mujoco"), default="pinocchio")
    parser.add_argument("--quiet", action="store_true", help="a tenth of the disturbance")
    args = parser.parse_args()
    how = args.none, args.simulator, args.quiet
    jobs = [Job(args.first + k, *how) for k in range(args.trials)]
    rows = told(filter(None, in_processes(run, jobs, args.workers)), args.json)
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
