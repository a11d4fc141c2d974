"""How often a fleet is wrong about what drifts, stands out, disagrees or is carried.

First the tests alone, on numbers drawn at random: parameters of which each scatters otherwise, and
whose standard deviations are off by a factor, as those of a real arm are. Then all: recordings
of one arm that never changes, each of another motion and noise, are put together to
fleets at random, with begins and temperatures at random: whatever is then said to drift is a false
alarm. A friction that is put into the torques of their moments (exactly: its column is there) shows
what is found. `python tests/benchmarks/fleet_trials.py`.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.learning.theta import Theta
from adapter.runs.fleet.arm import FleetArm, learn_arm
from adapter.runs.fleet.course import Series, courses
from adapter.runs.fleet.moments import LogMoments, learner_of, taken
from tests.helpers.arm_data import Motion, panda_model, record, rubbing

VISCOUS, COULOMB = 0.3, 0.2  # N m s/rad, N m
JOINT, EFFECT = 2, "viscous_friction"  # from 0; what is changed
CHANGED = EFFECT, JOINT + 1
PARAMETERS = 28  # of seven joints
DAYS, DEGREES = 30.0, 15.0  # that begins and temperatures span
Change = Callable[[int, float, float], float]  # number, share of the time, of the temperature


def with_friction(theta: Theta, log: LogMoments, joint: int, more: float) -> LogMoments:
    """The recording as it is with so much more viscous friction: tau' = tau + more * dq."""
    at, names = theta.rows, [effect.name for effect in theta.effects]
    columns = [len(effect.shapes) or 1 for effect in theta.effects]
    k = names.index(EFFECT)
    size = int(at.sizes[joint])
    change = np.eye(size + 1)
    change[size - theta.columns + sum(columns[:k]), -1] = more
    upper = np.triu_indices(size + 1)
    A = log.A.copy()
    moments = change.T @ theta.joint_moments(joint, A) @ change
    A[at.starts[joint] : at.starts[joint] + len(upper[0])] = moments[upper]
    return replace(log, A=A)


class Fleets:
    """Fleets at random from recordings of one arm.

    Args:
        count: of recordings; seconds: of each.
    """

    def __init__(self, count: int, seconds: float) -> None:
        self.model, truth = panda_model(), rubbing(VISCOUS, COULOMB)
        self.theta = learner_of(self.model).theta
        self.logs = [
            taken(record(truth, Motion(seconds, 1000 + k)).log(), self.model, f"{k:064d}", f"{k}")
            for k in range(count)
        ]

    def one(self, size: int, seed: int, change: Change, scatter: float) -> FleetArm:
        """An arm from `size` recordings; friction is scattered by a share of itself."""
        rng = np.random.default_rng([seed, size])
        chosen = rng.choice(len(self.logs), size, replace=False)
        when, warm = rng.uniform(size=(2, size))
        logs, told = [], {}
        for number, k in enumerate(chosen):
            more = change(number, when[number], warm[number]) * VISCOUS
            begin_s, mark = 1.7e9 + DAYS * 86_400.0 * when[number], None if number else "first"
            log = replace(self.logs[k], begin_s=begin_s, arm=mark)
            for joint in range(self.model.tree.n):
                own = VISCOUS * scatter * rng.standard_normal() + more * (joint == JOINT)
                log = with_friction(self.theta, log, joint, own) if own else log
            logs.append(log)
            told[log.content] = {"temperature": 20.0 + DEGREES * warm[number]}
        return learn_arm("arm", logs, self.model, told)


def drifting(share: float) -> Change:
    """Friction that grows by a share of itself from the first day to the last."""
    return lambda number, when, warm: share * when


def first_off(share: float) -> Change:
    """Friction that is more by a share of itself in one recording."""
    return lambda number, when, warm: share * (number == 0)


def counted(found: list[FleetArm]) -> dict[str, float]:
    """Shares of the arms of which something was said, and of those with the right drift."""
    counts: Counter[str] = Counter()
    for arm in found:
        ours = {(x.follows, *x.rivals) for x in arm.drifts if (x.effect, x.joint) == CHANGED}
        others = [x for x in arm.drifts if (x.effect, x.joint) != CHANGED]
        counts["drift_of_it"] += bool(ours)
        counts["drift_of_it_by_time"] += any("time" in x for x in ours)
        counts["drift_of_another"] += bool(others)
        out = {(arm.logs[x.number].moments.arm, x.effect, x.joint) for x in arm.standing_out}
        counts["stands_out"] += ("first", *CHANGED) in out
        counts["another_stands_out"] += any(x != ("first", *CHANGED) for x in out)
        counts["disagrees"] += any(x.disagrees for x in arm.logs)
        counts["carries"] += any(x.load is not None for x in arm.logs)
    return {key: round(value / len(found), 4) for key, value in counts.items()}


def drawn(size: int, seed: int, drift: float, off: float, tails: bool) -> tuple[bool, ...]:
    """Whether numbers that are drawn make the tests say: a drift, that drift, out, that one.

    Args:
        size: recordings; drift: of the first parameter from the first day to the last, and off: of
            the first recording's second one, both in standard deviations of the scatter.
        tails: whether the scatter has heavy ones (Student's t of 5) instead of a normal's.
    """
    rng = np.random.default_rng([seed, size])
    columns = {"time": DAYS * rng.uniform(size=size), "temperature": rng.uniform(size=size)}
    series = []
    for k in range(PARAMETERS):
        std = 0.3 * rng.lognormal(0.0, 0.3, size)
        own = 0.5 * rng.lognormal(0.0, 0.5) * std
        noise = rng.standard_t(5, size) / np.sqrt(5 / 3) if tails else rng.standard_normal(size)
        values = own * noise
        values += (k == 0) * drift * np.median(own) * columns["time"] / DAYS
        values[0] += (k == 1) * off * own[0]
        series.append(Series(str(k), 1, values, std))
    drifts, out = courses(series, columns)
    right = any(x.effect == "0" and "time" in (x.follows, *x.rivals) for x in drifts)
    wrong = any(x.effect != "0" or not drift for x in drifts)
    found = any((x.effect, x.number) == ("1", 0) for x in out)
    return wrong, right, any((x.effect, x.number) != ("1", 0) or not off for x in out), found


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--draws", type=int, default=1000, help="of each kind, for the tests alone")
    add("--fleets", type=int, default=50, help="of each kind, for all of it")
    add("--logs", type=int, default=100, help="that these are put together from")
    add("--seconds", type=float, default=8.0)
    add("--json", type=Path)
    args = parser.parse_args()
    found: list[dict[str, Any]] = []

    def tell(**told: Any) -> None:
        found.append(told)
        print(json.dumps(told), flush=True)

    names = "false_drift", "drift_found", "falsely_out", "out_found"
    for size in (6, 12, 30):
        for drift, off, tails in ((0, 0, False), (0, 0, True), (5, 5, False), (10, 10, False)):
            told = [drawn(size, k, drift, off, tails) for k in range(args.draws)]
            shares = dict(zip(names, np.mean(told, axis=0).round(4).tolist(), strict=True))
            tell(kind="drawn", logs=size, drift=drift, off=off, heavy_tails=tails, **shares)
    fleets = Fleets(args.logs, args.seconds) if args.fleets else None
    for size in (6, 12, 30):
        for kind, change, scatter in (
            ("nothing", drifting(0.0), 0.0),
            ("nothing", drifting(0.0), 0.05),
            ("drift of 0.1", drifting(0.1), 0.0),
            ("drift of 0.3", drifting(0.3), 0.05),
            ("first log off by 0.3", first_off(0.3), 0.0),
        ):
            if fleets is None:
                continue
            arms = [fleets.one(size, seed, change, scatter) for seed in range(args.fleets)]
            tell(kind=kind, logs=size, scatter=scatter, **counted(arms))
    if args.json is not None:
        args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
