"""The paper's section IV on one self-contained page: its figures, and its numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from adapter.experiments.falls import SETS
from adapter.experiments.page import atlas_figures as figures
from adapter.experiments.page import figure6, words
from adapter.experiments.page.beyond import beyond
from adapter.experiments.results import AtlasResults, PandaResults, Stated
from adapter.experiments.stated import PAPER_BASELINES
from adapter.gap.phrases import listed
from adapter.learning.batch.prediction_errors import LEAST_TORQUE
from adapter.model.numbers import DASH
from adapter.model.spatial import Array
from adapter.report.html import fill
from adapter.report.style import JOINT_COLORS
from adapter.report.tables import Table, Tile
from adapter.report.words import JOIN, NARROW

BASELINES = (
    "the feed-forward network",
    "the committee of extreme learning machines",
    "the Gaussian process",
)


def render_experiment(atlas: AtlasResults | None, panda: PandaResults | None, written: str) -> str:
    """The page as HTML text; what was not run is left out, with a reason.

    Args:
        atlas: results of section IV.A.
        panda: results of section IV.B.
        written: who wrote this, when and where, for the foot of the page.

    Raises:
        ValueError: results whose shapes do not fit their tree.
    """
    return fill("experiment.html", context(atlas, panda, written), "adapter.experiments")


def context(atlas: AtlasResults | None, panda: PandaResults | None, written: str) -> dict[str, Any]:
    """What the template shows."""
    shown = [*(atlas_tiles(atlas) if atlas else []), *(panda_tiles(panda) if panda else [])]
    reasons = [words.ATLAS_LEFT_OUT] if atlas is None else _atlas_reasons(atlas)
    if panda is None:
        reasons.append(words.PANDA_LEFT_OUT)
    elif not math.isfinite(panda.theta_start_s):
        reasons.append("Fig. 6b: θ was not learned, it waits until λ has converged.")
    learned = None
    if panda is not None:
        torque, names = figure6.torque_panel(panda), panda.tree.joint_names
        learned = {
            "joints": [(j % JOINT_COLORS + 1, name) for j, name in enumerate(names)],
            "lambda": figure6.lambda_panels(panda),
            "theta": [*figure6.theta_panels(panda), *([torque] if torque else [])],
            "logarithmic": figure6.logarithmic(panda),
            "stated": stated_table(panda.stated),
        }
    return {
        "headline": words.headline(atlas, panda),
        "tiles": shown,
        "columns": max(len(shown), 1),
        "left_out": reasons,
        "atlas": None if atlas is None else _atlas(atlas),
        "panda": learned,
        "beyond": beyond(atlas, panda),
        "sets": list(figures.SET_NAMES.items()),
        "written": written,
    }


def atlas_tiles(atlas: AtlasResults) -> list[Tile]:
    """Key figures of section IV.A, those that there are."""
    value = words.percent(atlas.learners[0].median["control"])
    found = [Tile(f"{words.OURS}, control set", value, "median relative error, eq. 20")]
    best, times = words.best_baseline(atlas), words.advantage(atlas)
    if best is not None:
        value = words.percent(best.median["control"])
        found.append(Tile("Best baseline, control set", value, f"{best.name}; median, eq. 20"))
    if times is not None:
        note = f"times smaller on the arm, joints {arm_joints(atlas)}"
        found.append(Tile("Advantage", words.scientific(times), note))
    return found


def panda_tiles(panda: PandaResults) -> list[Tile]:
    """Key figures of section IV.B, those that there are."""
    after, ratio = words.converged(panda).ours, words.last_ratio(panda)
    value = "not reached" if after is None else words.with_unit(float(after), "s", 3)
    found = [Tile("λ of the simulated Panda converged", value, "after the first motion")]
    if ratio is not None:
        times = words.scientific(ratio, 3)
        found.append(Tile("Its torque error at the end", times, "times batch least squares"))
    return found


def _atlas(atlas: AtlasResults) -> dict[str, Any]:
    histogram, moments = figures.histogram_panels(atlas)
    paper, others = figures.arm_panels(atlas)
    names = {learner.name for learner in atlas.learners}
    summary = figures.side_by_side(atlas)
    tuning = [(x.name, x.title.rstrip("."), words.sentences(x.tuning)) for x in atlas.learners]
    return {
        "n": atlas.tree.n,
        "limbs": [(limb.color % JOINT_COLORS + 1, limb.name) for limb in figures.limbs(atlas.tree)],
        "schema": [*figures.epoch_panels(atlas), histogram],
        "schema_more": [moments, *figures.schema_panels(atlas)],
        "not_converged": _not_converged(atlas),
        "paper": paper,
        "whole": figures.whole_panels(atlas),
        "others": others,
        "last": [figures.arm_panel(atlas), *([summary] if summary else [])],
        "arm": arm_joints(atlas),
        "not_judged": _not_judged(atlas),
        "compared": not names.isdisjoint(PAPER_BASELINES),
        "full": atlas.full,
        "stated": stated_table(atlas.stated),
        "learners": learner_table(atlas),
        "tuning": tuning,
    }


def arm_joints(atlas: AtlasResults) -> str:
    """The joints that the baselines learn, numbered from 1."""
    return f"{atlas.arm[0] + 1} to {atlas.arm[-1] + 1}"


def _not_converged(atlas: AtlasResults) -> str:
    """Which networks of Fig. 4 did not find their joint's frame; empty where all did."""
    names = atlas.not_converged
    if not names:
        return ""
    few = f"too few samples ({words.grouped(atlas.numbers['learned_samples'])})"
    if len(names) == atlas.tree.n:
        return f"None of the {atlas.tree.n} joints had converged; {few}."
    whose = f"{len(names)} joint{'' if len(names) == 1 else 's'} had not converged"
    return f"{whose}: {', '.join(names)}; {few}."


def _not_judged(atlas: AtlasResults) -> str:
    """Why some joints have no box in Fig. 5; empty where all have one."""
    joints = figures.not_judged(atlas)
    if not joints:
        return ""
    names = listed([f"{j + 1} ({atlas.tree.joint_names[j]})" for j in joints])
    which = f"Joint {names} has" if len(joints) == 1 else f"Joints {names} have"
    least = f"{LEAST_TORQUE:g} N m".replace(" ", NARROW)
    return (
        f"{which} no box: eq. 20 is judged only where |τ| > {least} (our choice, since relative "
        "errors of less say nothing), which is never exceeded there."
    )


def _atlas_reasons(atlas: AtlasResults) -> list[str]:
    """What of Figs. 4 and 5 is missing, and why."""
    kept = {label for label, _ in atlas.snapshots}
    names = {learner.name for learner in atlas.learners}
    return [
        *(
            f"Fig. 4{which}: λ's training has no {label}, it ended before."
            for label, which in figures.EPOCH_LETTERS.items()
            if label not in kept
        ),
        *(
            f"Fig. 5{words.LETTERS[name]}: {learner} was not run."
            for name, learner in zip(PAPER_BASELINES, BASELINES, strict=True)
            if name not in names
        ),
    ]


def stated_table(items: Sequence[Stated]) -> Table:
    """What the paper states, what we measured, what differs."""
    rows = [[x.what, x.paper or "not stated", words.ours_text(x), x.note] for x in items]
    return Table(["", "Paper states", "We measured", "Remark"], rows)


def learner_table(atlas: AtlasResults) -> Table:
    """A row per learner and set: errors, and how long it trained."""
    heads = ["Learner", "Joints", "Training", "Set", "Median", "99th percentile", "RMSE"]
    units = ["", "", "", "", "eq. 20", "eq. 20", "by joint, N m"]
    rows = []
    for learner in atlas.learners:
        joints, train = str(len(learner.rmse[SETS[0]])), words.with_unit(learner.train_s, "s", 3)
        row = [learner.name, joints, train]
        for name in SETS:
            errors = map(words.percent, (learner.median[name], learner.p99[name]))
            rows.append([*row, name, *errors, _spread(learner.rmse[name])])
            row = [""] * len(row)
    return Table(heads, rows, units)


def _spread(values: Array) -> str:
    """Smallest to largest over the joints."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return DASH
    low, high = words.scientific(float(finite.min())), words.scientific(float(finite.max()))
    return low if low == high else f"{low}{NARROW}–{JOIN}{NARROW}{high}"
