"""Contacts of a simulated arm: how soon they are seen, and how many are seen where none is.

Each trial moves a PyBullet Panda with real noise and friction at random, learns for `--learn`
seconds in lockstep and pushes the hand from then on for half a second every 5 seconds. The learned
model's observer and the documented model's see the same samples. `make trials`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.observer import ContactObserver
from adapter.control.settings import ExcitationSettings
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.learning.settings import LearnerSettings
from adapter.realtime.session import run_lockstep
from adapter.runs.config import PipelineSettings
from adapter.runs.contacts import ReplayObserver, kind_of
from adapter.runs.pipeline import make_front_end, make_learner
from drivers.interface import Array, JointSample
from sim.effects import Effect
from sim.plant import SimulatedArm
from sim.scenarios import Scenario, build
from tests.helpers.arm_data import panda_model
from tests.helpers.benchmark import options, told

PUSH_S, EVERY_S, SETTLE_S = 0.5, 5.0, 0.5
QUIET_FROM_S = 5.0  # after the begin of learning, before which nothing is counted


def pushed(seed: int, newton: float, begin_s: float, end_s: float) -> tuple[Scenario, list[float]]:
    """An arm with friction that is pushed in random directions, and when."""
    rng = np.random.default_rng([seed, 7])
    times, pushes = [], []
    at = begin_s
    while newton and at + EVERY_S <= end_s:
        way = rng.normal(size=3)
        fx, fy, fz = newton * way / np.linalg.norm(way)
        force = {"fx": float(fx), "fy": float(fy), "fz": float(fz), "mx": 0.0, "my": 0.0, "mz": 0.0}
        pushes.append(Effect("external_wrench", (), force, (at, at + PUSH_S)))
        times.append(at)
        at += EVERY_S
    arm = build("friction", seed)
    truth = replace(arm.truth, effects=(*arm.truth.effects, *pushes))
    return replace(arm, truth=truth), times


def trial(seed: int, newton: float, learn_s: float, seconds: float) -> dict[str, Any]:
    """One run; delays in ms and false contacts, by model."""
    arm, times = pushed(seed, newton, learn_s, learn_s + seconds)
    robot = panda_model()
    settings = PipelineSettings(learner=LearnerSettings(effects=REAL_ARM_EFFECTS))
    front_end, learner = make_front_end(robot, settings), make_learner(robot, settings)
    learned, documented = ReplayObserver(robot, learner), ContactObserver(robot)
    controller = ExcitationController(MotionLimits.of(robot), ExcitationSettings(seed=seed))

    class Learning:
        """Learns as long as it may: a push would be learned from as well."""

        def step(self, state: Array) -> None:
            if 1e-9 * int(state[:1].view(np.int64)[0]) < learn_s - SETTLE_S:
                learner.step(state)

    def each(sample: JointSample, command: Array | None) -> None:
        signals = np.array([[sample.q, sample.dq, sample.tau]])
        learned.step_each(np.array([sample.stamp_ns]), signals)
        documented.step(sample)

    driver = SimulatedArm(arm.plant())
    try:
        ended = run_lockstep(
            driver, front_end, Learning(), controller, learn_s + seconds, each=each
        )
    finally:
        driver.close()
    row: dict[str, Any] = {"seed": seed, "fault": ended.fault, "pushes": len(times)}
    for name, observer in (("learned", learned.observer), ("documented", documented)):
        row[name] = _score(observer, times, learn_s)
    kinds = [
        kind_of(c, learned.observer.frames, robot.gravity, robot.limits.effort).value
        for c in learned.observer.contacts
    ]
    return {**row, "kinds": kinds}


def _score(observer: ContactObserver, times: list[float], learn_s: float) -> dict[str, Any]:
    begun = np.array([1e-9 * contact.begin_ns for contact in observer.contacts])
    counted = begun[begun > learn_s - QUIET_FROM_S]
    delays = []
    for at in times:
        inside = counted[(counted >= at) & (counted < at + PUSH_S)]
        delays.append(1e3 * (inside[0] - at) if len(inside) else None)
    near = [((counted >= at) & (counted < at + PUSH_S + SETTLE_S)) for at in times]
    false = counted[~np.any(near, axis=0)] if near else counted
    return {"delay_ms": delays, "false": false.tolist(), "begun": begun.tolist()}


def main() -> None:
    """Run the trials asked for."""
    parser = options(__doc__, trials=20, first=100)
    parser.add_argument("--newton", type=float, default=10.0, help="0: no push at all")
    parser.add_argument("--learn", type=float, default=30.0, metavar="S")
    parser.add_argument("--seconds", type=float, default=60.0, help="after learning")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.trials)
    how = asked.newton, asked.learn, asked.seconds
    rows = told((trial(seed, *how) for seed in seeds), asked.json)
    for name in ("learned", "documented"):
        all_ms = [ms for row in rows for ms in row[name]["delay_ms"]]
        seen = [ms for ms in all_ms if ms is not None]
        quick = sum(ms <= 20.0 for ms in seen)
        median = np.median(seen) if seen else float("nan")
        false = sum(len(row[name]["false"]) for row in rows)
        print(
            f"{name}: {len(seen)} of {len(all_ms)} pushes seen, {quick} within 20 ms, median "
            f"{median:.0f} ms; {false} false contacts in {asked.seconds * len(rows):.0f} s"
        )


if __name__ == "__main__":
    main()
