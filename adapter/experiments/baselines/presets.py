"""The baselines as the experiment on ATLAS runs them, in full size and in less time.

On what they are judged: the paper shuffles samples of the same trajectories into train and test
set, at 1 kHz and with motion below some 2 Hz. A test sample then lies milliseconds from training
samples, so that the test error shows interpolation in time. Only the control set, of other
trajectories, shows what was learned of the arm. Settings are chosen for what the test set asks: by
the error on samples of the training set that are held out as the test set is, shuffled and in the
same share. Test and control set have no say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

from adapter.experiments.baselines.features import Columns
from adapter.experiments.baselines.lagrangian import DeepLagrangian
from adapter.experiments.baselines.learner import Baseline
from adapter.experiments.baselines.least_squares import RegressorLeastSquares
from adapter.experiments.baselines.paper import MEMBERS, ElmCommittee, FeedForward, GaussianProcess
from adapter.model.spatial import Array

Settings = Mapping[str, float]


@dataclass(frozen=True)
class Choice:
    """One learner of the comparison.

    Attributes:
        key: short name.
        title: in full.
        make: from settings (keyword arguments) to a learner that is ready to fit.
        candidates: settings of which the best on the validation part is taken; one alone where
            there is nothing to choose.
        trial: further settings of the learners that are compared, smaller than the final one: a
            trial takes about a tenth of the training's time, or less.
        otherwise: how the settings came about where nothing is chosen, a sentence.
    """

    key: str
    title: str
    make: Callable[..., Baseline]
    candidates: tuple[Settings, ...] = ({},)
    trial: Mapping[str, int] | None = None
    otherwise: str = "Nothing to choose."


def learners(
    columns: Columns, parents: Sequence[int], lam: Array, full: bool = False, seed: int = 0
) -> tuple[Choice, ...]:
    """The paper's three learners and two that a user would take today.

    Args:
        columns: layout of X.
        parents, lam: body schema of the arm, for least squares alone, see
            `RegressorLeastSquares`.
        full: the paper's sizes, and long training; else what fits in some minutes.
        seed: of all of them.
    """
    # what is cut down where the full size is not asked for; everything else is as in the paper
    epochs, members, steps = (200, MEMBERS, 30_000) if full else (40, 20, 6_000)
    pairs = product((0.1, 0.2, 0.3), (1e-9, 1e-7))
    return (
        Choice(
            "FFNN",
            "Feed-forward network",
            partial(FeedForward, epochs=epochs, seed=seed),
            tuple({"rate": rate} for rate in (1e-3, 2e-3, 4e-3)),
            {"epochs": 4},
        ),
        Choice(
            "ELM",
            "Committee of extreme learning machines",
            partial(ElmCommittee, members=members, seed=seed),
            tuple({"spread": spread, "ridge": ridge} for spread, ridge in pairs),
            {"members": 1},
        ),
        Choice(
            "GPR",
            "Gaussian process regression",
            partial(GaussianProcess, seed=seed),
            otherwise="Nothing chosen by hand.",
        ),
        Choice(
            "DeLaN",
            "Deep Lagrangian network",
            partial(DeepLagrangian, columns, steps=steps, seed=seed),
            tuple({"rate": rate} for rate in (1e-3, 2e-3)),
            {"steps": 600},
        ),
        Choice(
            "WLS",
            "Least squares, known body schema",
            partial(RegressorLeastSquares, columns, parents, lam),
        ),
    )
