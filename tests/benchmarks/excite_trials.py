"""Designed motion beside random motion: how long each takes to the same held-out torque error.

Both move the simulated Panda with its noise from the same pose, in lockstep, as `adapter run`
does; the learner and batch least squares on the learner's own moments are judged on a motion that
neither has seen, every quarter of a second. Also the condition number of the base parameters'
regressor, made with Pinocchio, over the first ten seconds of each path. `make trials`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio
from scipy.linalg import qr
from trials import Task, columns_of, held_out, learn

from adapter.learning.learner import OnlineLearner
from adapter.model.robots import documented
from adapter.signals.records import stamp_of
from tests.helpers.benchmark import options, told
from tests.helpers.robot_models import PANDA

KINDS = ("random", "designed")
EVERY_S, PATH_S = 0.25, 10.0
REFERENCES_S = (4.0, 6.0, 10.0)  # of random motion; by 10 s what the filter leaves is in the way
SAMPLES = 500
Curve = list[tuple[float, float, float]]


def curve(seed: int, kind: str, seconds: float) -> tuple[Curve, np.ndarray]:
    """(t, learner's error, least squares' error), shares of the effort limits, rms of all joints;
    and the states' motion."""
    q, dq, ddq, tau = held_out(seed)
    rows: Curve = []
    states: list[np.ndarray] = []
    Y: list[np.ndarray] = []

    def look(learner: OnlineLearner, record: np.ndarray) -> None:
        t, theta = 1e-9 * stamp_of(record), learner.theta
        at = learner.layout
        if t >= 1.0:
            states.append(np.array([record[part] for part in (at.q, at.dq, at.ddq)]))
        if not theta.updates or (rows and t < rows[-1][0] + EVERY_S):
            return
        if not Y:
            Y.append(columns_of(theta, q, dq, ddq))
        errors = [Y[0] @ th - tau for th in (theta.th, theta.least_squares())]
        effort = documented("panda").limits.effort
        own = [float(np.sqrt(np.mean((e / effort) ** 2))) for e in errors]
        rows.append((t, own[0], own[1]))

    learn(Task("nominal", seed, seconds, ("--excitation", kind)), look)
    return rows, np.array(states)


def condition(states: np.ndarray) -> float:
    """Of the regressor (Pinocchio) of base parameters picked by QR over random motion."""
    model = pinocchio.buildModelFromUrdf(str(PANDA))
    data, n = model.createData(), states.shape[2]

    def stacked(motion: np.ndarray) -> np.ndarray:
        parts = []
        for q, dq, ddq in motion:
            full = [np.zeros(model.nv) for _ in range(3)]
            for whole, part in zip(full, (q, dq, ddq), strict=True):
                whole[:n] = part
            Y = pinocchio.computeJointTorqueRegressor(model, data, *full)
            parts.append(Y[:n, : 10 * n])
        return np.vstack(parts)

    rng = np.random.default_rng(0)
    anyhow = rng.uniform(-3.0, 3.0, (SAMPLES, 3, n)) * np.array([1.0, 1.0, 3.0])[:, None]
    matrix = stacked(anyhow)
    _, triangle, order = qr(matrix, mode="economic", pivoting=True)
    size = np.abs(np.diag(triangle))
    base = np.sort(order[: np.count_nonzero(size > 1e-9 * size[0])])
    shown = states[:: max(len(states) // SAMPLES, 1)]
    return float(np.linalg.cond(stacked(shown)[:, base]))


def reached(rows: Curve, column: int, error: float) -> float | None:
    """When the error is there and stays, s; None where it never is."""
    above = [k for k, row in enumerate(rows) if row[column] > error]
    after = above[-1] + 1 if above else 0
    return rows[after][0] if after < len(rows) else None


def trial(seed: int, seconds: float) -> dict[str, Any]:
    """Times to what random motion reaches after some seconds, and the condition numbers."""
    rows, conditions = {}, {}
    for kind in KINDS:
        rows[kind], states = curve(seed, kind, seconds)
        conditions[kind] = condition(states[: int(PATH_S * 1000)])
    found: dict[str, Any] = {"seed": seed, "condition": conditions}
    for column, name in ((1, "learner"), (2, "least_squares")):
        found[name] = {}
        for reference_s in REFERENCES_S:
            goal = next(row[column] for row in rows["random"] if row[0] >= reference_s)
            times = {kind: reached(rows[kind], column, goal) for kind in KINDS}
            found[name][reference_s] = {"error": goal, **times}
    return found


def main() -> None:
    """Run the trials."""
    args = options(__doc__, trials=10, first=0, seconds=13.0).parse_args()
    seeds = range(args.first, args.first + args.trials)
    rows = told((trial(seed, args.seconds) for seed in seeds), args.json)
    for name in ("learner", "least_squares"):
        for at in REFERENCES_S:
            times = [[row[name][at][kind] or np.inf for kind in KINDS] for row in rows]
            ratio = [designed / drawn for drawn, designed in times]
            print(
                f"{name}: to what random motion has after {at:g} s, time over random's: median "
                f"{np.median(ratio):.2f}, worst {max(ratio):.2f}"
            )
    less = [row["condition"]["random"] / row["condition"]["designed"] for row in rows]
    print(f"condition number smaller by {np.median(less):.1f} (median), {min(less):.1f} (least)")


if __name__ == "__main__":
    main()
