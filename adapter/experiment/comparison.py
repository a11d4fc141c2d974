"""The learners that the FOP networks are compared with, on the right arm (Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.baselines.features import Columns, arm_problem, sub_chain, sub_parents
from adapter.baselines.presets import Choice, learners
from adapter.experiment.atlas import Errors, Say
from adapter.experiment.results import Learned
from adapter.experiment.trajectories import SETS, Split, Trajectories, sets_of
from adapter.spatial import Array
from adapter.tree import Tree

Tables = dict[str, tuple[Array, Array]]  # by set: inputs X and torques Y
JUDGED = 30_000  # random samples of each set; all of them would take a committee half an hour


def arm_tables(source: Trajectories, parts: Split, joints: Sequence[str], carrier: str) -> Tables:
    """Inputs and torques of the arm for every set; the training set in its shuffled order."""
    found: dict[str, list[tuple[Array, Array]]] = {name: [] for name in SETS}
    for data, rows in sets_of(source, parts):
        x, y = arm_problem(data, joints, carrier)
        for name, own in rows.items():
            found[name].append((x[own], y[own]))
    tables = {name: _joined(pairs) for name, pairs in found.items()}
    order = np.argsort(np.argsort(parts.train))
    x, y = tables["train"]
    tables["train"] = x[order], y[order]
    return tables


def _joined(pairs: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    x, y = zip(*pairs, strict=True)
    return np.concatenate(x), np.concatenate(y)


def choices(
    tree: Tree, lam: Array, joints: Sequence[str], carrier: str, full: bool, seed: int
) -> tuple[Choice, ...]:
    """The learners, not yet trained; the body schema λ (n, 6) is for least squares alone."""
    index = sub_chain(tree, joints, carrier)
    return learners(Columns(len(index)), sub_parents(tree, index), lam[index], full, seed)


def compare(tables: Tables, chosen: Sequence[Choice], seed: int, say: Say) -> list[Learned]:
    """Train every learner on the training set and judge it on all three sets.

    Args:
        tables: of `arm_tables`.
        chosen: of `choices`.
        seed: of the samples that are judged.
        say: takes a sentence on progress.
    """
    judged = {name: _some(table, seed) for name, table in tables.items()}
    found = []
    for choice in chosen:
        say(f"training: {choice.title}")
        choice.learner.fit(*tables["train"], progress=say)
        errors = Errors(tables["train"][1].shape[1])
        for name, (x, y) in judged.items():
            errors.add(name, y, choice.learner.predict(x))
        facts = choice.learner.facts()
        sizes = ", ".join(f"{value:,.6g} {what}" for what, value in facts.sizes.items())
        learned = Learned(choice.key, choice.title, train_s=facts.train_s)
        learned.sizes = dict(facts.sizes)
        learned.tuning = [sizes, *facts.tuning, *([choice.chosen] if choice.chosen else [])]
        found.append(errors.into(learned))
    return found


def _some(table: tuple[Array, Array], seed: int) -> tuple[Array, Array]:
    """Random samples of a set, all of a small one."""
    rows = np.random.default_rng(seed).permutation(len(table[0]))[:JUDGED]
    return table[0][rows], table[1][rows]
