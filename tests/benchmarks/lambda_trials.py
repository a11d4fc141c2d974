"""λ of any tree from any start: how well it predicts the motion of poses never seen.

    python tests/benchmarks/lambda_trials.py trees --first 0 --trials 200 --seeds 3
    python tests/benchmarks/lambda_trials.py arms --json FILE

Trees are drawn as CAD draws them (`tests.helpers.random_trees`). Arms are the URDFs of
`example-robot-data` (extra `robots`): ERD_ROBOTS names their folder where the package lies
somewhere else.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from adapter.control.excitation import RandomMotion
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.learning.theta import Filtered
from adapter.model.self_model import Limits, SelfModel
from adapter.model.urdf import read_urdf
from adapter.physics.identifiability import random_motion
from adapter.physics.kernels import Frames, base_at_rest, frames_of, link_motions, placed
from adapter.signals.front_end import FrontEnd
from tests.helpers.benchmark import Row, options, shown, told, write
from tests.helpers.random_trees import cad_tree

ARMS = {
    "ur3": "ur_description/urdf/ur3_robot.urdf",
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "z1": "z1_description/urdf/z1.urdf",
    "kinova": "kinova_description/robots/kinova.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "baxter": "baxter_description/urdf/baxter.urdf",
    "talos_arm": "talos_data/robots/talos_left_arm.urdf",
    "tiago": "tiago_description/robots/tiago.urdf",
    "so101": "so_arm_description/urdf/so101.urdf",
    "allegro": "allegro_hand_description/urdf/allegro_right_hand.urdf",
    "double_pendulum": "double_pendulum_description/urdf/double_pendulum.urdf",
}
LARGE, ARM_S, TREE_S = 15, 1.5, 3.0  # joints, s after the soft start
GOAL = 1e-3  # of the motion, relative
POSES = 60
STILL = 1e-2  # m/s, rad/s, ...: added to what errors are relative to, as some robots' links rest
NO_ARMS = (
    "arms: not tried, since example-robot-data is not installed: pip install "
    "'panda-adapter[robots]', or name the folder of its robots in ERD_ROBOTS"
)
NOISE = 2e-5, 1e-3  # of q, rad, and dq, rad/s


def robots_folder() -> Path | None:
    """Where the URDFs of example-robot-data lie; None where they are not installed."""
    given = os.environ.get("ERD_ROBOTS")
    if given:
        return Path(given)
    found = importlib.util.find_spec("example_robot_data")
    if found is None or found.origin is None:
        return None
    prefix = next(x for x in Path(found.origin).parents if x.name == "cmeel.prefix")
    return prefix / "share" / "example-robot-data" / "robots"


def states_of(model: SelfModel, seconds: float, seed: int) -> np.ndarray:
    """Filtered states of a random motion with an encoder's noise, link motion synthesized."""
    lower, upper = (np.nan_to_num(x) for x in (model.limits.lower, model.limits.upper))
    q0 = 0.5 * (np.clip(lower, -np.pi, np.pi) + np.clip(upper, -np.pi, np.pi))
    motion = RandomMotion(MotionLimits.of(model), q0, ExcitationSettings(seed=seed))
    rows = []
    for _ in range(round(1e3 * seconds)):
        motion.advance(1e-3)
        rows.append((motion.q, motion.dq))
    q, dq = (np.array(x) for x in zip(*rows, strict=True))
    rng = np.random.default_rng([seed, 5])
    q, dq = (x + std * rng.normal(size=x.shape) for x, std in zip((q, dq), NOISE, strict=True))
    stamps = 1_000_000 * np.arange(len(q), dtype=np.int64)
    return FrontEnd(model).step_table(stamps, q, dq, np.zeros_like(q))


def motion_error(model: SelfModel, frames: Frames) -> float:
    """Largest error of any link's v, w, a or dw over unseen poses, relative to its rms.

    A link that hardly moves is measured by a tenth of what the liveliest does.
    """
    motion = random_motion(model.tree, POSES, 99)
    base = base_at_rest(model.gravity)[None]
    true, found = np.empty((2, *motion.q.shape, 12))
    link_motions(frames_of(model.tree, model.lam), motion, base, true)
    link_motions(frames, motion, base, found)
    size, off = (
        np.sqrt((x.reshape(*x.shape[:2], 4, 3) ** 2).sum(axis=(0, 3))) for x in (true, found - true)
    )
    return float((off / np.maximum(size, 0.1 * size.max(axis=0) + STILL)).max())


def learn(model: SelfModel, seed: int) -> Row:
    """Learn λ from random motion; when it was right for good, and what was said of it."""
    n = model.tree.n
    limit_s = (TREE_S if n > LARGE else ARM_S) + ExcitationSettings().start_s
    states = states_of(model, limit_s, seed)
    front_end = FrontEnd(model)
    filtered = Filtered(front_end.filter.noise_gain, front_end.delay_s)
    learner = OnlineLearner(model.tree, model.gravity, LearnerSettings(seed=seed), filtered)
    schema = learner.schema
    said, right_s, wrongly, worst = None, None, 0, 0.0
    for state in states:
        learner.learn_schema(state[None])
        if schema.updates % 20:
            continue
        now = 1e-9 * float(state[:1].view(np.int64)[0]) + front_end.delay_s
        error = motion_error(model, placed(model.tree, schema.R0, schema.p))
        right = error < GOAL
        right_s = (right_s or now) if right else None
        if schema.converged:
            said = said or now
            wrongly += not right
            worst = max(worst, error)
        else:
            said = None
    return {
        "robot": model.name,
        "joints": n,
        "seed": seed,
        "error": error,
        "right_s": right_s,
        "said_s": said,
        "said_wrongly": wrongly,
        "worst_while_said": worst,
        "restarts": schema.check.restarts,
        "failed": error >= GOAL or said is None or wrongly > 0,
    }


def tree_trial(number: int, seeds: int) -> list[Row]:
    """One random tree from several starts and motions."""
    return [learn(cad_tree(number), seed) for seed in range(seeds)]


def arm_trial(name: str, seeds: int) -> list[Row]:
    """One arm from several starts and motions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = robots_folder()
        assert folder is not None
        model = read_urdf(folder / ARMS[name])
    if not model.limits.velocity.any():  # a model for simulation alone: nothing may move
        model = replace(model, limits=Limits.unknown(model.tree.n))
    return [{**learn(model, seed), "robot": name} for seed in range(seeds)]


def main() -> None:
    """Run the trials that were asked for."""
    parser = options(__doc__, seeds=3, workers=2)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}")
    parser.add_argument("--first", type=int, default=0, help="number of the first tree")
    parser.add_argument("--trials", type=int, default=200, help="how many trees")
    args = parser.parse_args()
    rows: list[Row] = []
    with ProcessPoolExecutor(args.workers) as pool:
        for kind in args.kinds or KINDS:
            if kind not in KINDS:
                parser.error(f"no kind '{kind}'; have: {', '.join(KINDS)}")
            rows += _trials(pool, kind, args)
    write(args.json, rows)


def _trials(pool: ProcessPoolExecutor, kind: str, args: argparse.Namespace) -> list[Row]:
    """All trials of a kind, told one by one; none of arms that are not installed."""
    jobs: Any = ARMS if kind == "arms" else range(args.first, args.first + args.trials)
    if kind == "arms" and robots_folder() is None:
        print(NO_ARMS)
        return []
    rows = told(
        chain.from_iterable(pool.map(partial(KINDS[kind], seeds=args.seeds), jobs)), line=shown
    )
    print(f"{kind}: {sum(row['failed'] for row in rows)} of {len(rows)} failed", flush=True)
    return rows


KINDS: dict[str, Callable[..., list[Row]]] = {"trees": tree_trial, "arms": arm_trial}


if __name__ == "__main__":
    main()
