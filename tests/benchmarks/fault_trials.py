"""Random faults, blockages and false estimates in lockstep, on each driver: is every stop in order?

    PYTHONPATH=. python tests/benchmarks/fault_trials.py --driver sim --trials 100

Counted is what must never be: a command or a reference beyond a limit, contact torque on a joint
that is above 0.15 of its effort (at least 1 N m) 0.15 s after the stop, a stop by a blockage that
names no joint. Ends with 1 if any was. Each second arm's model is trusted (`--trust-model`).
"""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import replace

import numpy as np

from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.push_bound import left_at_most
from adapter.control.resting import CarriedWeight
from adapter.control.settings import ExcitationSettings
from adapter.errors import SettingsError
from adapter.model.robots import documented
from adapter.realtime.following import FeedforwardBound, LearnedFeedforward
from adapter.realtime.session import run_lockstep
from adapter.realtime.snapshot import SnapshotWriter
from adapter.signals.front_end import FrontEnd
from drivers.faults.driver import with_faults
from drivers.interface import JointSample
from sim.joint_effects import Obstacles
from sim.scenarios import Scenario, build
from tests.helpers.benchmark import options, write
from tests.helpers.live_learners import nothing_known
from tests.helpers.lockstep_drivers import BEGINS_LOADED_S, BEGINS_S, LET_GO, opened

PANDA = documented("panda")
N, LIMITS = PANDA.tree.n, MotionLimits.of(PANDA)
SECONDS = 1.6
FAULTS = ("lost=0.02", "late=0.02", "repeated=0.05", "reordered=0.02", "corrupt=0.01", "nan=0.02",
          "spike=0.01", "stuck:{j}@{t}+0.1", "jump:{j}@{t}+0.05", "silence@{t}+0.05",
          "clock@{t}+100")  # fmt: skip
NAMED = r"joint ?\d|usable joint reading|newer joint reading|reflex|without"
KINDS = ("position", "speed", "acceleration", "jerk", "torque", "rate", "contact", "unnamed")


def world_of(rng: np.random.Generator, seed: int, name: str) -> tuple[Scenario, str]:
    """A scenario with at most one blockage in the motion's first second, and what it is.

    `name`: of the driver; it says when the motion begins.
    """
    after_s = float(rng.uniform(0.0, 1.0))
    kind = str(rng.choice(["none", "held", "wall", "load"]))
    begins_s = (BEGINS_LOADED_S if kind == "load" else BEGINS_S)[name]
    trouble: dict = {"t_s": begins_s + after_s}
    if kind == "held":
        count = int(rng.integers(1, N + 1))
        trouble["held"] = sorted(int(j) + 1 for j in rng.choice(N, count, replace=False))
    elif kind == "wall":
        trouble["wall"] = float(rng.uniform(0.0, 0.05))
    elif kind == "load":
        trouble["load"] = float(rng.uniform(0.5, 8.0))
    noise = str(rng.choice(["real", "none"]))
    return build("nominal", seed, noise=noise, trouble=trouble if kind != "none" else {}), kind


class Account:
    """What a trial did that it must not do."""

    def __init__(self, controller: ExcitationController, obstacles: Obstacles) -> None:
        self._controller, self._obstacles = controller, obstacles
        self.broken: Counter[str] = Counter()
        self.peak = 0.0
        self._tau: np.ndarray | None = None
        self._most = LIMITS.torque_rate * 1e-3 + 1e-9
        self._last: tuple[float, np.ndarray] | None = None

    def note(self, sample: JointSample, tau: np.ndarray | None) -> None:
        self.peak = max(self.peak, float(np.abs(self._obstacles.torque).max()))
        ref = self._controller.reference
        if tau is None or ref is None:
            return
        self._count("torque", np.abs(tau) > LIMITS.effort)
        if self._tau is not None:
            self._count("rate", np.abs(tau - self._tau) > self._most)
        self._tau = tau
        self._count("position", (ref.q < LIMITS.lower) | (ref.q > LIMITS.upper))
        self._count("speed", np.abs(ref.dq) > LIMITS.velocity)
        self._count("acceleration", np.abs(ref.ddq) > LIMITS.acceleration)
        if self._last is not None and ref.time_s > self._last[0]:
            jerk = (ref.ddq - self._last[1]) / (ref.time_s - self._last[0])
            self._count("jerk", np.abs(jerk) > LIMITS.jerk)
        self._last = ref.time_s, ref.ddq.copy()

    def _count(self, kind: str, wrong: np.ndarray) -> None:
        self.broken[kind] += bool(wrong.any())


def forward_of(
    rng: np.random.Generator,
) -> tuple[LearnedFeedforward | ModelFeedforward | None, SnapshotWriter | None]:
    """No feed-forward, the documented one, or one that a false estimate is published to."""
    kind = rng.integers(3)
    if kind == 0:
        return None, None
    if kind == 1:
        return ModelFeedforward.of(PANDA), None
    board = SnapshotWriter.create(PANDA.tree.joint_names, name=None)
    theta = PANDA.theta.copy()
    theta[int(rng.integers(N))] += rng.normal(0.0, 1.0, 10) * [10.0, 3, 3, 3, 1, 1, 1, 1, 1, 1]
    known = replace(nothing_known(N, N, 0), lam=PANDA.lam, lam_converged=True, theta_converged=True)
    std = np.full((N, 10), float(rng.choice([0.0, 0.01, 10.0])))
    board.publish(replace(known, theta=theta, theta_std=std))
    bound = FeedforwardBound(PANDA, ModelFeedforward.of(PANDA))
    forward = LearnedFeedforward(PANDA.tree, PANDA.gravity, bound=bound)
    forward.attach(board.name)
    return forward, board


def trial(name: str, seed: int) -> tuple[Counter[str], str]:
    """What one trial broke, and how it ended."""
    rng = np.random.default_rng([seed, 14])
    world, trouble = world_of(rng, seed, name)
    fault = str(rng.choice(("", *FAULTS))) if trouble == "none" else ""
    fault = fault.format(j=int(rng.integers(1, N + 1)), t=round(float(rng.uniform(0.2, 1.2)), 3))
    forward, board = forward_of(rng)
    motion = ExcitationSettings(
        seed=seed, share=float(rng.uniform(0.2, 0.9)), start_s=0.4, stop_s=0.3
    )
    expected = ModelFeedforward.of(PANDA)
    controller = ExcitationController(LIMITS, motion, ControlSettings(), forward, expected=expected)
    said = ""
    try:
        with opened(name, world) as (driver, obstacles):
            account, trusted = Account(controller, obstacles), bool(seed % 2)
            if not (trusted and driver.adds_gravity):  # as in `run`
                controller.weight = CarriedWeight(PANDA, trusted)
            arm = with_faults(driver, fault, seed) if fault else driver
            try:
                result = run_lockstep(
                    arm, FrontEnd(PANDA), None, controller, SECONDS, each=account.note
                )
                said = result.fault or ""
                for _ in range(
                    0 if name == "can" else LET_GO
                ):  # there braking takes longer by itself
                    driver.read()
                left = np.abs(obstacles.torque)
                if said and trouble in ("held", "wall"):
                    account._count("contact", left > left_at_most(LIMITS.effort))
            except SettingsError as error:  # before any motion
                said = f"not started: {error}"
    finally:
        controller.detach()
        if board is not None:
            board.close()
            board.unlink()
    if said and not re.search(NAMED, said):
        account.broken["unnamed"] += 1
    cause = re.sub(r"-?\d+(\.\d+)?", "#", said)[:70] if said else "to its end"
    return (
        account.broken,
        f"{trouble or fault}{' ' + fault.split('=')[0].split(':')[0] if fault else ''}: {cause}",
    )


def main() -> int:
    parser = options(__doc__, trials=100, first=0)
    parser.add_argument("--driver", choices=["sim", "can", "fci"], default="sim")
    args = parser.parse_args()
    broken: Counter[str] = Counter()
    ends: Counter[str] = Counter()
    begun, bad = time.perf_counter(), []
    for seed in range(args.first, args.first + args.trials):
        found, end = trial(args.driver, seed)
        ends[end] += 1
        wrong = {kind: count for kind, count in found.items() if count}
        broken.update(wrong.keys())
        if wrong:
            bad.append((seed, wrong, end))
            print(f"seed {seed}: {wrong} {end}", flush=True)
    each_s = (time.perf_counter() - begun) / max(args.trials, 1)
    print(f"{args.driver}: {args.trials} trials, {each_s:.2f} s each; trials that broke a limit:")
    print("  " + ", ".join(f"{kind} {broken[kind]}" for kind in KINDS))
    for end, count in ends.most_common():
        print(f"  {count:5d}  {end}")
    numbers = {"trials": args.trials, "broken": {k: broken[k] for k in KINDS}, "ends": ends}
    write(args.json, {args.driver: numbers})
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
