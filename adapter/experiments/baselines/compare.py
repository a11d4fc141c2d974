"""The learners that the FOP networks are compared with, on the right arm (Fig. 5).

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
from typing import Any

import numpy as np

from adapter.experiments.baselines.by_physics import DeepLagrangian, RegressorLeastSquares
from adapter.experiments.baselines.learner import Baseline, Columns, arm_problem
from adapter.experiments.baselines.paper import MEMBERS, ElmCommittee, FeedForward, GaussianProcess
from adapter.experiments.falls import SETS, TRAIN_SHARE, Falls, Split, sets_of
from adapter.experiments.results import BOX_PERCENTILES, LearnerScores
from adapter.learning.batch.prediction_errors import relative_errors
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


def contenders(
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
    network = partial(FeedForward, epochs=epochs, seed=seed)
    rates = tuple({"rate": rate} for rate in (1e-3, 2e-3, 4e-3))
    committee = partial(ElmCommittee, members=members, seed=seed)
    pairs = product((0.1, 0.2, 0.3), (1e-9, 1e-7))
    units = tuple({"spread": spread, "ridge": ridge} for spread, ridge in pairs)
    process, by_hand = partial(GaussianProcess, seed=seed), "Nothing chosen by hand."
    lagrangian = partial(DeepLagrangian, columns, steps=steps, seed=seed)
    squares = partial(RegressorLeastSquares, columns, parents, lam)
    return (
        Choice("FFNN", "Feed-forward network", network, rates, {"epochs": 4}),
        Choice("ELM", "Committee of extreme learning machines", committee, units, {"members": 1}),
        Choice("GPR", "Gaussian process regression", process, otherwise=by_hand),
        Choice("DeLaN", "Deep Lagrangian network", lagrangian, rates[:2], {"steps": 600}),
        Choice("WLS", "Least squares, known body schema", squares),
    )


Say = Callable[[str], None]
Table = tuple[Array, Array]  # inputs X and torques Y
JUDGED = 20_000  # random samples of each set; all of them would take a committee half an hour


def arm_tables(
    source: Falls, parts: Split, joints: Sequence[str], carrier: str
) -> dict[str, Table]:
    """Inputs and torques of the arm for every set, the training set in its shuffled order."""
    found: dict[str, list[Table]] = {name: [] for name in SETS}
    for data, rows in sets_of(source, parts):
        x, y = arm_problem(data, joints, carrier)
        for name, own in rows.items():
            found[name].append((x[own], y[own]))
    sets = {}
    for name, pairs in found.items():
        xs, ys = zip(*pairs, strict=True)
        order = np.argsort(np.argsort(parts.train)) if name == "train" else slice(None)
        sets[name] = np.concatenate(xs)[order], np.concatenate(ys)[order]
    return sets


def compare(
    sets: dict[str, Table], chosen: Sequence[Choice], seed: int, say: Say
) -> list[LearnerScores]:
    """Choose every learner's settings, train it on the training set, judge it on all three sets.

    Args:
        sets: of `arm_tables`.
        chosen: of `contenders`.
        seed: of the samples that are judged, and of the validation part.
        say: takes a sentence on progress.
    """
    judged = {}
    for name, (x, y) in sets.items():
        rows = np.random.default_rng(seed).permutation(len(x))[:JUDGED]
        judged[name] = x[rows], y[rows]
    parted = validation_part(sets["train"], seed)
    found = []
    for choice in chosen:
        selection = select(choice, *parted, say)
        say(f"training: {choice.title}")
        learner = choice.make(**selection["chosen"])
        learner.fit(*sets["train"], progress=say)
        errors = Errors(sets["train"][1].shape[1])
        for name, (x, y) in judged.items():
            errors.add(name, y, learner.predict(x))
        sizes = ", ".join(f"{value:,.6g} {what}" for what, value in learner.sizes.items())
        learned = LearnerScores(choice.key, choice.title, train_s=learner.train_s)
        learned.sizes, learned.selection = dict(learner.sizes), selection
        learned.tuning = [sizes, *learner.tuning, _told(choice, selection)]
        found.append(errors.into(learned))
    return found


# --- settings, chosen on a part of the training set that no trial learns from -------------------


def validation_part(train: Table, seed: int) -> tuple[Table, Table]:
    """The training set parted once more: X and Y to learn from, and others to judge settings by.

    Drawn as the test set is drawn from all samples, shuffled and in the same share, so that it
    asks of a learner what the test set will ask. Those two sets are not even handed over.
    """
    x, y = train
    order = np.random.default_rng([seed, 1]).permutation(len(x))
    cut = round(TRAIN_SHARE * len(x))
    fit, judge = order[:cut], order[cut:][:JUDGED]
    return (x[fit], y[fit]), (x[judge], y[judge])


def select(choice: Choice, fit: Table, judge: Table, say: Say) -> dict[str, Any]:
    """The candidate with the smallest median error by eq. 20 on the validation part, all joints.

    Args:
        fit, judge: samples that trials learn from, and are judged by.

    Returns:
        chosen (settings), candidates (settings and validation_median of each; none where there
        is nothing to choose), validation_samples, trial (the sizes of the learners compared).
    """
    if len(choice.candidates) == 1:
        return {"chosen": dict(choice.candidates[0]), "candidates": []}
    say(f"choosing among {len(choice.candidates)} settings: {choice.title}")
    rows = []
    for candidate in choice.candidates:
        learner = choice.make(**{**(choice.trial or {}), **candidate})
        learner.fit(*fit)
        error = float(np.nanmedian(relative_errors(judge[1], learner.predict(judge[0]))))
        rows.append({**candidate, "validation_median": error})
    errors = [row["validation_median"] for row in rows]
    best = int(np.argmin(np.nan_to_num(errors, nan=np.inf)))
    return {
        "chosen": dict(choice.candidates[best]),
        "candidates": rows,
        "validation_samples": len(judge[0]),
        "trial": {"samples": len(fit[0]), **(choice.trial or {})},
    }


def _told(choice: Choice, selection: dict[str, Any]) -> str:
    """How the settings were chosen, a sentence."""
    if not selection["candidates"]:
        return choice.otherwise
    own = ", ".join(f"{name} {value:g}" for name, value in selection["chosen"].items())
    sizes = ", ".join(f"{value} {name}" for name, value in selection["trial"].items())
    best = min(row["validation_median"] for row in selection["candidates"])
    return (
        f"Chosen among {len(selection['candidates'])} settings by the error on "
        f"{selection['validation_samples']} shuffled samples held out of the training set "
        f"(neither test nor control set): {own}, {best:.2%} there; compared with {sizes}."
    )


# --- errors ------------------------------------------------------------------------------------


class Errors:
    """Relative and absolute torque errors, gathered trajectory by trajectory."""

    def __init__(self, joints: int) -> None:
        self._joints = joints
        self._relative: dict[str, list[Array]] = {name: [] for name in SETS}
        self._square = {name: np.zeros(joints) for name in SETS}
        self._count = dict.fromkeys(SETS, 0)

    def add(self, name: str, tau: Array, estimate: Array) -> None:
        """Joint torques (m, joints) of a set, and what a learner says of them."""
        if len(tau):
            self._relative[name].append(relative_errors(tau, estimate))
            self._square[name] += np.square(tau - estimate).sum(axis=0)
            self._count[name] += len(tau)

    def into(self, learned: LearnerScores) -> LearnerScores:
        """Fill in boxes, percentiles and root mean squares."""
        for name in SETS:
            if not self._relative[name]:
                continue
            columns = [x[~np.isnan(x)] for x in np.concatenate(self._relative[name]).T]
            nothing = np.full(len(BOX_PERCENTILES), np.nan)
            boxes = [np.percentile(x, BOX_PERCENTILES) if len(x) else nothing for x in columns]
            learned.boxes[name] = np.array(boxes)
            every = np.concatenate(columns)
            learned.median[name], learned.p99[name] = map(float, np.percentile(every, (50, 99)))
            learned.rmse[name] = np.sqrt(self._square[name] / max(self._count[name], 1))
        return learned
