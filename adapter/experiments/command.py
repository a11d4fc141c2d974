"""`adapter experiment`: the paper's experiments (section IV) again, beside what it states.

In section IV.B a Panda learns λ and θ online at 1 kHz, from its first motion on.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.experiments.atlas import run_atlas
from adapter.experiments.page.page import render_experiment
from adapter.experiments.results import AtlasResults, PandaResults, Stated
from adapter.experiments.topology import found_trees, panda_logs, panda_moves, topology_trials
from adapter.learning.settings import LearnerSettings
from adapter.model.robots import documented
from adapter.model.spatial import Array
from adapter.report.html import write_whole
from adapter.runs import score, terminal
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import collect
from adapter.runs.pipeline import make_learner
from adapter.runs.run_folder import RunData, run_data
from sim.scenarios import build

PAGE = "experiment.html"


def run(args: argparse.Namespace) -> int:
    """Carry the command out; what one experiment found is written before the next begins."""
    folder = terminal.results_folder(args.out, "experiment")
    atlas: AtlasResults | None = None
    panda: PandaResults | None = None
    for name in dict.fromkeys(args.names):
        if name == "atlas":
            atlas = run_atlas(args)
            print_stated("ATLAS, section IV.A", atlas.stated)
        else:
            panda = run_panda(args.seed, 40.0, args.seeds)  # the paper's λ needs as long
            print_stated("Panda, section IV.B", panda.stated)
        figures = {
            name: {**results.numbers, "stated": [asdict(row) for row in results.stated]}
            for name, results in (("atlas", atlas), ("panda", panda))
            if results is not None
        }
        written = f"panda-adapter {terminal.program_version()}, seed {args.seed}"
        write_whole(folder / PAGE, render_experiment(atlas, panda, written))
        terminal.write_json(folder / "experiment.json", figures)
        terminal.write_json(args.json, figures)
    terminal.show(f"report {folder / PAGE}")
    return 0


def print_stated(title: str, stated: list[Stated]) -> None:
    """The paper's figures and ours."""
    rows = []
    for row in stated:
        unit = "" if row.ours is None else row.unit
        rows.append((row.what, row.paper or "-", f"{shown(row.ours)} {unit}".strip()))
    terminal.print_table(("", "paper", "ours"), rows, title=title, title_justify="left")


def shown(value: Any) -> str:
    """A figure in few digits."""
    value = terminal.json_ready(value)
    if value is None:
        return "not run"
    if isinstance(value, float):
        return f"{value:.3g}" if np.isfinite(value) else str(value)
    return str(value)


def panda_results(run: RunData, rate_hz: float, discovered: dict[str, Any]) -> PandaResults:
    """What a run over a simulated or real Panda shows beside the paper's Fig. 6.

    Args:
        run: as a run folder holds it.
        rate_hz: samples a second of arm time.
        discovered: of `topology_trials` on recordings of such arms.
    """
    n, lam, theta = run.n, run.figures["lambda"], run.figures["theta"]
    score_time, ratio = torque_ratio(run)
    start_s = theta["started_s"]
    numbers = {
        "joints": n,
        "samples": run.figures["samples"],
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
    return PandaResults(
        tree=run.documented.tree,
        time_s=run.times(run.schema_trace),
        lam=run.schema_trace[:, 1:].reshape(-1, n, 6),
        lam_true=run.documented.lam if run.reference is None else run.reference,
        lam_shown=run.lam_shown > 0.99,
        theta_time_s=run.times(run.theta_trace),
        theta=run.theta_trace[:, 1 : 1 + 10 * n].reshape(-1, n, 10),
        theta_start_s=float("nan") if start_s is None else float(start_s),
        torque_time_s=score_time,
        torque_error=ratio,
        stated=panda_stated(numbers),
        numbers=numbers,
    )


def panda_stated(numbers: dict[str, Any]) -> list[Stated]:
    """The figures that the paper's text gives, beside ours."""
    ours, turn = numbers.__getitem__, f"{score.ROTATION_GOAL_RAD:g} rad"
    within = f"for good inside {turn} and {1e3 * score.POSITION_GOAL_M:g} mm in every direction"
    batch = f"{score.TORQUE_GOAL:g} times batch least squares"
    return [
        Stated("rate_hz", "rate of the online learning", "1 kHz", ours("rate_hz"), "Hz"),
        Stated("joints", "joints of the arm", "7", ours("joints")),
        Stated("lambda_converged_s", "λ converged after", "40 s", ours("lambda_converged_s"), "s",
               f"{within} that the data show"),
        Stated("theta_started_s", "learning of θ begins at", "100 s", ours("theta_started_s"), "s",
               "as soon as λ has converged, instead of at a time set by hand"),
        Stated("theta_converged_s",
               f"θ's torque error for good within {batch} after",
               "not stated", ours("theta_converged_s"), "s"),
        Stated("min_pseudo_inertia_eigenvalue",
               "smallest eigenvalue of any link's pseudo-inertia, ever", "a feasible set",
               ours("min_pseudo_inertia_eigenvalue"), "",
               "above zero: every link is a possible body in every step"),
        found_trees(numbers["discover"]),
    ]  # fmt: skip


def torque_ratio(run: RunData) -> tuple[Array, Array]:
    """(k,) s and (k,) torque error before learning from a sample, over that of batch least
    squares on all samples; joints in units of their noise, over the last 2 s."""
    rows = run.score_trace
    if not len(rows):
        return np.zeros(0), np.zeros(0)
    tau, error = run.score_signals()[3:]
    time_s = run.times(rows)
    ours = score.trailing_rms(time_s, error / run.noise, score.TORQUE_WINDOW_S)
    best = score.trailing_rms(time_s, (tau - run.batch) / run.noise, score.TORQUE_WINDOW_S)
    return time_s, ours / np.maximum(best, 1e-300)


def run_panda(seed: int, duration_s: float, topologies: int) -> PandaResults:
    """Learn for some seconds of arm time from the first motion on; λ starts near zero.

    Args:
        seed: of everything random.
        duration_s: of the learning.
        topologies: how many other recordings are shuffled, for discovery to find their tree.
    """
    robot, world = documented("panda"), build("nominal", seed)
    settings = PipelineSettings(learner=LearnerSettings(seed=seed, effects=REAL_ARM_EFFECTS))
    learner = make_learner(robot, settings)
    _, samples, front_end = panda_moves(world, robot, duration_s, settings, learner)
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.json"
        world.write_truth(truth)
        reference = score.reference_from(truth, robot)
    outcome, began_ns, delay_s = collect(learner), front_end.first_moving_ns, front_end.delay_s
    course = score.Course(len(samples), front_end.refused, began_ns, delay_s)
    numbers = terminal.json_ready(score.figures(outcome, robot, reference, course))
    of = outcome, robot, numbers, reference
    run = run_data(*of, delay_s=delay_s, first_moving_ns=began_ns)
    found = topology_trials(panda_logs(topologies, seed), robot.tree, seed)
    span_s = 1e-9 * (samples[-1].stamp_ns - samples[0].stamp_ns)
    return panda_results(run, (len(samples) - 1) / span_s, found)
