"""What the text of section IV states, beside what was measured here."""

from __future__ import annotations

from typing import Any

from adapter.experiments.baselines.paper import MEMBERS
from adapter.experiments.falls import SETS
from adapter.experiments.results import Stated
from adapter.learning.batch.prediction_errors import LEAST_TORQUE
from adapter.runs.score import POSITION_GOAL_M, ROTATION_GOAL_RAD, TORQUE_GOAL

PAPER_BASELINES = ("FFNN", "ELM", "GPR")


def _baselines(numbers: dict[str, Any]) -> list[Stated]:
    """The sizes of the paper's three."""

    def size(learner: str, what: str) -> int | None:
        sizes = numbers["learners"].get(learner, {}).get("sizes", {})
        return round(sizes[what]) if what in sizes else None

    arm = numbers["arm_joints"]
    members, points = size("ELM", "members"), size("ELM", "points")
    return [
        Stated("arm", "joints of the right arm", "24 to 30", f"{arm[0]} to {arm[-1]}"),
        Stated("ffnn_units", "network: tanh units", "1000", size("FFNN", "units")),
        Stated("elm_members", "committee: machines", "50", members, "", f"{MEMBERS} with --full"),
        Stated("elm_units", "committee: tanh units of each", "4000", size("ELM", "units")),
        Stated("elm_points", "committee: samples of each", "10 000", points),
        Stated("elm_samples", "committee: samples in all", "50 000",
               None if members is None or points is None else members * points, "",
               "the paper's 50 times 10 000 would be 500 000"),
        Stated("gpr_points", "Gaussian process: samples", "10 000", size("GPR", "points")),
    ]  # fmt: skip


def found_trees(trials: dict[str, Any]) -> Stated:
    """Of how many recordings discovery found the whole tree."""
    return Stated(
        "discover",
        "N and A unknown: trees found",
        "future work",
        f"{trials['right']} of {trials['trials']}" if trials["trials"] else None,
        "",
        f"from at most {trials['motion_s']:.1f} s; links and joints shuffled and renamed",
    )


def atlas_stated(numbers: dict[str, Any]) -> list[Stated]:
    """What the paper's text states, beside ours."""
    kinematics = max(numbers["kinematic_error_max"].values())
    networks = max(numbers["kinematic_error_max_networks"].values())
    branches = dict.fromkeys(x["name"] for x in numbers["sub_problems"])
    whole = sum(x["name"] == "whole tree" for x in numbers["sub_problems"])
    ratio = numbers["control_error_ratio_to_best_baseline"]
    seconds = numbers["trajectory_s"]
    return [
        Stated("joints", "degrees of freedom", "30", numbers["joints"]),
        Stated("trajectories", "random trajectories", "63", numbers["trajectories"]),
        Stated("trajectory_s", "length of each, at 1 kHz", "10 s", seconds, "s"),
        Stated("control_trajectories", "of them control", "13", numbers["control_trajectories"]),
        Stated("samples", "samples for training and test", "500 000",
               numbers["train_samples"] + numbers["test_samples"]),
        Stated("train_samples", "of them for training", "75 %", numbers["train_samples"], "",
               "the paper prints 75 %/25 % as test/train"),
        Stated("learned_samples", "samples for λ and θ", "1 % of training",
               numbers["learned_samples"]),
        Stated("minibatch", "samples of a mini-batch; cycles", "10; 10",
               f"{numbers['minibatch']}; {numbers['cycles']}", "",
               "N problems (eq. 18) from random λ, each batch a step of recursive Gauss-Newton"),
        Stated("solver", "solver of θ", "interior point (fmincon)", numbers["theta_solver"]),
        Stated("kinematic_error_max", "largest |k - k_hat|, control set", "negligible", kinematics,
               "", "in m/s, rad/s, m/s² and rad/s², λ from moments"),
        Stated("kinematic_error_max_networks", "the same, λ from mini-batches", "negligible",
               networks),
        Stated("sub_problems", "problems for θ", "3: legs, upper body", ", ".join(branches), "",
               f"found from A; all bodies together {whole} times in the end, later ones weighted "
               "by what the one before left"),
        *(
            Stated(f"torque_median_{name}", f"median error by eq. 20, {name} set", "minimal",
                   numbers["torque_relative_error_median_networks"][name], "",
                   f"where |τ| > {LEAST_TORQUE:g} N m; λ from mini-batches")
            for name in SETS
        ),
        Stated("torque_median_moments", "the same, control set, λ from moments", "minimal",
               numbers["torque_relative_error_median"]["control"]),
        *_baselines(numbers),
        Stated("worst_baseline", "worst of the three, control set", "GPR",
               numbers["worst_baseline"]),
        Stated("control_error_ratio", "right arm, control set: best baseline's error over ours",
               "not stated", ratio, "times"),
        Stated("learning_s", "time to learn λ and θ", "not stated", numbers["learning_s"], "s",
               "without simulating the data; λ from mini-batches"),
        Stated("noise_ratio", "torque error with noise over least squares with true λ",
               "not stated", numbers["noise"]["ratio"], "", "control set"),
        Stated("online_samples_per_second", "samples that the online learner takes",
               "1 kHz (Panda)", numbers["online"]["samples_per_second"], "1/s", "on one core"),
        found_trees(numbers["discover"]),
    ]  # fmt: skip


def panda_stated(numbers: dict[str, Any]) -> list[Stated]:
    """The figures that the paper's text gives, beside ours."""
    ours = numbers.__getitem__
    return [
        Stated("rate_hz", "rate of the online learning", "1 kHz", ours("rate_hz"), "Hz"),
        Stated("joints", "joints of the arm", "7", ours("joints")),
        Stated("lambda_converged_s", "λ converged after", "40 s", ours("lambda_converged_s"), "s",
               f"for good inside {ROTATION_GOAL_RAD:g} rad and {1e3 * POSITION_GOAL_M:g} mm in "
               "every direction that the data show"),
        Stated("theta_started_s", "learning of θ begins at", "100 s", ours("theta_started_s"), "s",
               "as soon as λ has converged, instead of at a time set by hand"),
        Stated("theta_converged_s",
               f"θ's torque error for good within {TORQUE_GOAL:g} times batch least squares after",
               "not stated", ours("theta_converged_s"), "s"),
        Stated("min_pseudo_inertia_eigenvalue",
               "smallest eigenvalue of any link's pseudo-inertia, ever", "a feasible set",
               ours("min_pseudo_inertia_eigenvalue"), "",
               "above zero: every link is a possible body in every step"),
        found_trees(numbers["discover"]),
    ]  # fmt: skip
