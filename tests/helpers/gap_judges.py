"""What a result is worth beyond its names: torque error on a motion that no fit has seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from adapter.model.model_file import load_model
from drivers.files.mcap import Log
from sim.effects import effect_from
from sim.hidden import Trial
from tests.helpers.gap_oracle import Oracle, rms, second
from tests.helpers.gap_scorer import Row
from tests.helpers.gap_tools import pinocchio_recording


def torque_judge(trial: Trial, recording: Log, result: dict[str, Any], folder: Path) -> Row:
    """Torque RMSE at 25 Hz of the model that was written, against that of the oracle's fit.

    Both are fitted to `recording` and judged on a second recording of the same arm. The effects
    are those of the findings, computed by the tests' formulas; of the model file only θ is used.

    Returns:
        `torque_ratio`: rms over the joints of the ratios; `torque_rmse_nm`, `oracle_rmse_nm`.
    """
    if not result.get("model_out"):
        return {}
    place = Path(result["model_out"])
    theta = load_model(place if place.is_absolute() else folder / place).theta
    other = second(trial)
    unseen = Oracle(other, pinocchio_recording(other))
    fit = Oracle(trial, recording).fit()
    best = rms(unseen.residual(fit.effects, fit.theta, True))
    found = tuple(effect_from(finding) for finding in result["findings"])
    ours = rms(unseen.residual(found, theta, False))
    return {
        "torque_ratio": float(np.sqrt(np.mean(np.square(ours / best)))),
        "torque_rmse_nm": ours.tolist(),
        "oracle_rmse_nm": best.tolist(),
    }
