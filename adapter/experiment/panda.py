"""Section IV.B of the paper: a Panda learns λ and θ online at 1 kHz, from its first motion on."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.experiment.atlas_figures import found_trees
from adapter.experiment.results import PandaResults, Stated
from adapter.run_folder import RunData
from adapter.score import TORQUE_WINDOW_S, trailing_rms
from adapter.spatial import Array

PAPER_SCHEMA_S, PAPER_THETA_START_S = 40.0, 100.0  # of the paper's own experiment


def panda_results(run: RunData, rate_hz: float, discovered: dict[str, Any]) -> PandaResults:
    """What a run over a simulated or real Panda shows beside the paper's Fig. 6.

    Args:
        run: as a run folder holds it.
        rate_hz: samples a second of arm time.
        discovered: of `topology_trials` on recordings of such arms.
    """
    n = run.n
    theta_time = run.times(run.theta_trace)
    score_time, ratio = torque_ratio(run)
    figures = run.figures
    lam, theta = figures["lambda"], figures["theta"]
    start_s = theta["started_s"]
    numbers = {
        "samples": figures["samples"],
        "rate_hz": rate_hz,
        "lambda_converged_s": lam["converged_s"],
        "lambda_rotation_error_rad": max(lam["rotation_error_rad"]),
        "lambda_position_error_m": max(lam["position_error_m"]),
        "lambda_directions_shown": lam["identifiable_rank"],
        "theta_started_s": start_s,
        "theta_converged_s": theta["converged_s"],
        "theta_torque_rmse_nm": theta["torque_rmse_nm"],
        "theta_torque_ratio_at_end": float(ratio[-1]) if len(ratio) else None,
        "min_pseudo_inertia_eigenvalue": theta["min_pseudo_inertia_eigenvalue"],
        "discover": discovered,
    }
    reference = run.documented.lam if run.reference is None else run.reference
    return PandaResults(
        tree=run.documented.tree,
        time_s=run.times(run.schema_trace),
        lam=run.schema_trace[:, 1:].reshape(-1, n, 6),
        lam_true=reference,
        lam_shown=run.lam_shown > 0.99,
        theta_time_s=theta_time,
        theta=run.theta_trace[:, 1 : 1 + 10 * n].reshape(-1, n, 10),
        theta_start_s=float("nan") if start_s is None else float(start_s),
        torque_time_s=score_time,
        torque_error=ratio,
        stated=stated(numbers),
        numbers=numbers,
    )


def torque_ratio(run: RunData) -> tuple[Array, Array]:
    """(k,) s and (k,) torque error before learning from a sample, over that of batch least
    squares on all samples; joints in units of their noise, over the last 2 s."""
    rows = run.score_trace
    if not len(rows):
        return np.zeros(0), np.zeros(0)
    tau, error = run.score_signals()[3:]
    time_s = run.times(rows)
    ours = trailing_rms(time_s, error / run.noise, TORQUE_WINDOW_S)
    best = trailing_rms(time_s, (tau - run.batch) / run.noise, TORQUE_WINDOW_S)
    return time_s, ours / np.maximum(best, 1e-300)


def stated(numbers: dict[str, Any]) -> list[Stated]:
    """The figures that the paper's text gives, beside ours."""

    def ours(key: str) -> float | int | str | None:
        value = numbers[key]
        assert value is None or isinstance(value, float | int | str)
        return value

    return [
        Stated("rate_hz", "rate of the online learning", "1 kHz", ours("rate_hz"), "Hz"),
        Stated("joints", "joints of the arm", "7", 7),
        Stated(
            "lambda_converged_s",
            "λ converged after",
            f"{PAPER_SCHEMA_S:g} s",
            ours("lambda_converged_s"),
            "s",
            "for good inside 0.01 rad and 5 mm in every direction that the data show",
        ),
        Stated(
            "theta_started_s",
            "learning of θ begins at",
            f"{PAPER_THETA_START_S:g} s",
            ours("theta_started_s"),
            "s",
            "as soon as λ has converged, instead of at a time set by hand",
        ),
        Stated(
            "theta_converged_s",
            "θ's torque error for good within 1.1 times batch least squares after",
            "not stated",
            ours("theta_converged_s"),
            "s",
        ),
        Stated(
            "min_pseudo_inertia_eigenvalue",
            "smallest eigenvalue of any link's pseudo-inertia, ever",
            "a feasible set",
            ours("min_pseudo_inertia_eigenvalue"),
            "",
            "above zero: every link is a possible body in every step",
        ),
        found_trees(numbers["discover"]),
    ]
