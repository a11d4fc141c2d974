"""What an experiment found, for the terminal, the JSON file and the page."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adapter.model.spatial import Array
from adapter.model.tree import Tree

PAPER_BASELINES = ("FFNN", "ELM", "GPR")
# Of a box by eq. 20: whisker, quartile, median, quartile, whisker.
BOX_PERCENTILES = (5.0, 25.0, 50.0, 75.0, 95.0)


@dataclass(frozen=True)
class Stated:
    """A figure that the paper's text states beside ours.

    Attributes:
        key: in the JSON file.
        what: it is, a few words.
        paper: as the paper states it; empty where it does not.
        ours: the value; None where it was not run.
        unit: of ours; empty for a pure number.
        note: what differs, if anything.
    """

    key: str
    what: str
    paper: str
    ours: float | int | str | None
    unit: str = ""
    note: str = ""


@dataclass
class LearnerScores:
    """One learner of the comparison (Fig. 5).

    Attributes:
        name: short, "FFNN".
        title: in full.
        boxes: by set ("train", "test", "control"): (joints, 5) relative errors by eq. 20 at
            `BOX_PERCENTILES`.
        rmse: by set, (joints,) N m.
        median: by set, of all joints' relative errors.
        p99: by set, 99th percentile of them.
        train_s: seconds of training.
        tuning: sentences.
        sizes: numbers of units, samples, ... by name.
        selection: how settings were chosen: chosen, candidates with their errors on a validation
            part, its number of samples, sizes of the trials; empty where there was no choice to
            make.
    """

    name: str
    title: str
    boxes: dict[str, Array] = field(default_factory=dict)
    rmse: dict[str, Array] = field(default_factory=dict)
    median: dict[str, float] = field(default_factory=dict)
    p99: dict[str, float] = field(default_factory=dict)
    train_s: float = 0.0
    tuning: list[str] = field(default_factory=list)
    sizes: dict[str, float] = field(default_factory=dict)
    selection: dict[str, Any] = field(default_factory=dict)


@dataclass
class AtlasResults:
    """Section IV.A.

    Attributes:
        tree, true_lam: of the robot, (n, 6).
        arm: indices of the joints that the baselines learn.
        snapshots: (label, (n, 6)) λ at epochs 0, 50, 100 and final.
        cost: (steps,) of λ's training by eq. 18, mean over the joints.
        error_edges: (bins + 1,) log10 of |k - k_hat|.
        error_counts: by kind (v, w, a, dw), (bins,), of the λ that the mini-batch networks end
            with (the last of `snapshots`), on the samples they learned from.
        learners: FOPnet first.
        stated: figures beside the paper's.
        numbers: everything for the JSON file.
        moments_error_counts: as `error_counts`, of λ from the moments of the same samples.
        not_converged: names of the joints whose networks did not converge.
        full: whether the baselines had the paper's sizes.
    """

    tree: Tree
    true_lam: Array
    arm: tuple[int, ...]
    snapshots: list[tuple[str, Array]]
    cost: Array
    error_edges: Array
    error_counts: dict[str, Array]
    learners: list[LearnerScores]
    stated: list[Stated]
    numbers: dict[str, Any]
    moments_error_counts: dict[str, Array] = field(default_factory=dict)
    not_converged: tuple[str, ...] = ()
    full: bool = False


@dataclass
class PandaResults:
    """Section IV.B.

    Attributes:
        tree: of the arm.
        time_s: (t,) s since the first motion, of `lam`.
        lam: (t, n, 6) as learned.
        lam_true: (n, 6).
        lam_shown: (n, 6) bool, what the data can show.
        theta_time_s: (u,) likewise.
        theta: (u, n, 10) as learned.
        theta_start_s: when θ's learning began; not a number where it never did.
        torque_time_s: (k,) likewise.
        torque_error: (k,) torque error of a sample before it was learned from, over that of batch
            least squares on all samples.
        stated: figures beside the paper's.
        numbers: everything for the JSON file.
    """

    tree: Tree
    time_s: Array
    lam: Array
    lam_true: Array
    lam_shown: np.ndarray
    theta_time_s: Array
    theta: Array
    theta_start_s: float
    torque_time_s: Array
    torque_error: Array
    stated: list[Stated]
    numbers: dict[str, Any]
