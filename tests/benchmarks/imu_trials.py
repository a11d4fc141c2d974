"""Trials of sensors glued on the links of bent Pandas, in Pinocchio's motion: 30 s, 10 arms.

    python tests/benchmarks/imu_trials.py --json runs/imu_trials.json

Goal: axes placed to 0.2 degrees and 1 mm against each other, some links without a sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from adapter.learning.settings import LearnerSettings, SchemaSettings
from adapter.model.spatial import matrix_from_zxz
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import learned_model
from adapter.runs.replay import ReplayOptions, replay
from adapter.signals.frame_topics import with_link_imus
from tests.helpers.arm_data import panda_model
from tests.helpers.benchmark import options, told
from tests.helpers.imu_data import Parts, axis_errors, record

SEEDS, SECONDS = 10, 30.0
GOAL_DEG, GOAL_MM = 0.2, 1.0
SENSED: tuple[Sequence[int], ...] = (range(7), (1, 3, 5, 6), (0, 2, 4, 6), (1, 3, 6), (2, 6))
PARTS = (Parts(), Parts(rate_hz=200.0, joints_hz=500.0))


def trial(seed: int) -> dict[str, Any]:
    """One bent arm; sensors on other links and of other rates from seed to seed."""
    links, parts = SENSED[seed % len(SENSED)], PARTS[seed // len(SENSED) % len(PARTS)]
    glued = record(seed, links, SECONDS, parts)
    log, names = with_link_imus(glued.log(), panda_model())
    settings = PipelineSettings(learner=LearnerSettings(schema=SchemaSettings(imus=names)))
    outcome = replay(log, panda_model(), settings, ReplayOptions(50)).outcome
    model = learned_model(outcome, panda_model())
    errors = axis_errors(glued.truth, matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:])
    angle, distance, offset, turn = (float(np.abs(x).max()) for x in errors)
    return {
        "seed": seed,
        "links": [i + 1 for i in links],
        "rate_hz": parts.rate_hz,
        "degrees": max(angle, turn),
        "mm": max(distance, offset),
        "converged": outcome.lam_converged,
        "source": model.lambda_source,
    }


def main() -> None:
    """Run them, print one line each, write all."""
    args = options(__doc__, seeds=SEEDS).parse_args()
    rows = told(map(trial, range(args.seeds)), args.json)
    bad = [row for row in rows if row["degrees"] > GOAL_DEG or row["mm"] > GOAL_MM]
    print(f"{len(rows) - len(bad)} of {len(rows)} within {GOAL_DEG} degrees and {GOAL_MM} mm")


if __name__ == "__main__":
    main()
