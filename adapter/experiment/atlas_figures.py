"""The humanoid's figures: all for the JSON file, the stated ones beside the paper's."""

from __future__ import annotations

from typing import Any

from adapter.experiment.atlas import Body, Judged
from adapter.experiment.results import BOX_PERCENTILES, Learned, Stated
from adapter.experiment.trajectories import Split
from adapter.tree import Tree
from adapter.tree_data import TreeData

BASELINES = ("FFNN", "ELM", "GPR")  # the paper's


def numbers_of(
    body: Body,
    judged: Judged,
    noise: dict[str, Any],
    learners: list[Learned],
    parts: Split,
    data: TreeData,
    tree: Tree,
) -> dict[str, Any]:
    """Every number of the experiment under a key of its own."""
    ours, arm = judged.learned, judged.arm
    paper = [x for x in learners if x.name in BASELINES]
    best = min(paper, key=lambda x: x.median["control"], default=None)
    worst = max(paper, key=lambda x: x.median["control"], default=None)
    return {
        "joints": tree.n,
        "trajectories": len(parts.lengths) + len(parts.control),
        "control_trajectories": len(parts.control),
        "train_samples": len(parts.train),
        "test_samples": len(parts.test),
        "learned_samples": len(data),
        "kinematic_error_max": judged.kinematics.largest,
        "kinematic_error_max_networks": judged.networks.largest,
        "kinematic_error_max_training": judged.training.largest,
        "torque_relative_error_median": ours.median,
        "torque_relative_error_p99": ours.p99,
        "torque_rmse_nm": ours.rmse,
        "min_pseudo_inertia_eigenvalue": body.theta.min_eigenvalue,
        "base_parameters": body.theta.rank,
        "theta_converged": body.theta.converged,
        "schema_networks_not_converged": [
            name
            for name, done in zip(tree.joint_names, body.networks.converged, strict=True)
            if not done
        ],
        "sub_problems": [
            {"name": stage.name, "bodies": len(stage.bodies), "rank": stage.rank,
             "parameters": stage.parameters, "wall_s": stage.wall_s}
            for stage in body.theta.stages
        ],
        "learning_s": body.learning_s,
        "schema_networks_s": body.schema_s,
        "schema_moments_s": body.moments_s,
        "theta_s": body.theta_s,
        "noise": noise,
        "learners": {
            x.name: {
                "median": x.median, "p99": x.p99, "rmse_nm": x.rmse, "boxes": x.boxes,
                "train_s": x.train_s, "sizes": x.sizes, "tuning": x.tuning,
            }
            for x in (*learners, arm)
        },
        "box_percentiles": BOX_PERCENTILES,
        "best_baseline": None if best is None else best.name,
        "worst_baseline": None if worst is None else worst.name,
        "control_error_ratio_to_best_baseline": (
            None if best is None else best.median["control"] / max(arm.median["control"], 1e-300)
        ),
    }  # fmt: skip


def baselines(learners: dict[str, dict[str, Any]]) -> list[Stated]:
    """The sizes of the paper's three."""

    def size(learner: str, what: str) -> int | None:
        sizes = learners.get(learner, {}).get("sizes", {})
        return round(sizes[what]) if what in sizes else None

    members, points = size("ELM", "members"), size("ELM", "points")
    return [
        Stated("arm", "joints of the right arm", "24 to 30", "24 to 30"),
        Stated("ffnn_units", "network: tanh units", "1000", size("FFNN", "units")),
        Stated("elm_members", "committee: machines", "50", members, "", "50 with --full"),
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


def stated(numbers: dict[str, Any]) -> list[Stated]:
    """What the paper's text states, beside ours."""
    kinematics = max(numbers["kinematic_error_max"].values())
    networks = max(numbers["kinematic_error_max_networks"].values())
    branches = dict.fromkeys(x["name"] for x in numbers["sub_problems"])
    ratio = numbers["control_error_ratio_to_best_baseline"]
    seconds = numbers["trajectory_s"]
    return [
        Stated("joints", "degrees of freedom", "30", numbers["joints"]),
        Stated("trajectories", "random trajectories", "63", numbers["trajectories"]),
        Stated("trajectory_s", "length of each, at 1 kHz", "10 s", seconds, "s"),
        Stated("control_trajectories", "of them control", "13", numbers["control_trajectories"]),
        Stated(
            "samples", "samples for training and test", "500 000",
            numbers["train_samples"] + numbers["test_samples"],
        ),
        Stated(
            "train_samples", "of them for training", "75 %", numbers["train_samples"], "",
            "the paper prints 75 %/25 % as test/train",
        ),
        Stated("learned_samples", "samples for λ and θ", "1 % of training",
               numbers["learned_samples"]),
        Stated("minibatch", "samples of a mini-batch; cycles", "10; 10", "10; 10", "",
               "N problems (eq. 18) from random λ, each batch a step of recursive Gauss-Newton"),
        Stated("solver", "solver of θ", "interior point (fmincon)", "interior point (Clarabel)"),
        Stated(
            "kinematic_error_max", "largest |k - k_hat|, control set", "negligible", kinematics,
            "", "in m/s, rad/s, m/s² and rad/s², λ from moments",
        ),
        Stated(
            "kinematic_error_max_networks", "the same, λ from mini-batches", "negligible",
            networks,
        ),
        Stated("sub_problems", "problems for θ", "3: legs, upper body", ", ".join(branches), "",
               "found from A; then all bodies together twice, the second time weighted by what "
               "the first left"),
        *(
            Stated(f"torque_median_{name}", f"median error by eq. 20, {name} set", "minimal",
                   numbers["torque_relative_error_median"][name], "", "where |τ| > 0.1 N m")
            for name in ("train", "test", "control")
        ),
        *baselines(numbers["learners"]),
        Stated("worst_baseline", "worst of the three, control set", "GPR",
               numbers["worst_baseline"]),
        Stated("control_error_ratio", "right arm, control set: best baseline's error over ours",
               "not stated", ratio, "times"),
        Stated("learning_s", "time to learn λ and θ", "not stated", numbers["learning_s"], "s",
               "without simulating the data"),
        Stated("noise_ratio", "torque error with noise over least squares with true λ",
               "not stated", numbers["noise"]["ratio"], "", "control set"),
        Stated("online_samples_per_second", "samples that the online learner takes",
               "1 kHz (Panda)", numbers["online"]["samples_per_second"], "1/s", "on one core"),
        found_trees(numbers["discover"]),
    ]  # fmt: skip
