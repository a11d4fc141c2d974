"""The paper's section IV on one self-contained page: its figures, and its numbers beside ours."""

from __future__ import annotations

import math
import string
from pathlib import Path
from typing import Any

from adapter.experiment.results import AtlasResults, PandaResults
from adapter.report import experiment_convergence as convergence
from adapter.report import experiment_panels as panels
from adapter.report import experiment_tables as tables
from adapter.report import experiment_tree as trees
from adapter.report.experiment_words import (
    ATLAS_LEFT_OUT,
    OURS,
    PANDA_LEFT_OUT,
    advantage,
    best_baseline,
    fopnet,
    headline,
    last_ratio,
    letter,
    measured,
    percent,
    scientific,
    with_unit,
)
from adapter.report.html import fill, write_whole
from adapter.report.page import Tile
from adapter.report.style import JOINT_COLORS

TEMPLATE = "experiment.html"
PAPER_LEARNERS = (
    ("a", "the feed-forward network"),
    ("b", "the committee of extreme learning machines"),
    ("c", "the Gaussian process"),
    ("d", OURS),
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
    return fill(TEMPLATE, context(atlas, panda, written))


def write_experiment(
    path: str | Path, atlas: AtlasResults | None, panda: PandaResults | None, written: str
) -> Path:
    """Write the page, whole or not at all. Returns the path. See `render_experiment`.

    Raises:
        RunFolderError: the file cannot be written.
        ValueError: results whose shapes do not fit their tree.
    """
    return write_whole(path, render_experiment(atlas, panda, written))


def context(atlas: AtlasResults | None, panda: PandaResults | None, written: str) -> dict[str, Any]:
    """What the template shows."""
    shown = [*(atlas_tiles(atlas) if atlas else []), *(panda_tiles(panda) if panda else [])]
    reasons = [ATLAS_LEFT_OUT] if atlas is None else _atlas_reasons(atlas)
    reasons += [PANDA_LEFT_OUT] if panda is None else _panda_reasons(panda)
    return {
        "headline": headline(atlas, panda),
        "tiles": shown,
        "columns": max(len(shown), 1),
        "left_out": reasons,
        "atlas": None if atlas is None else _atlas(atlas),
        "panda": None if panda is None else _panda(panda),
        "sets": list(panels.SET_NAMES.items()),
        "written": written,
    }


def atlas_tiles(atlas: AtlasResults) -> list[Tile]:
    """Key figures of section IV.A, those that there are."""
    found = []
    ours, best, times = fopnet(atlas), best_baseline(atlas), advantage(atlas)
    if ours is not None and "control" in ours.median:
        value = percent(ours.median["control"])
        found.append(Tile(f"{OURS}, control set", value, "median relative error, eq. 20"))
    if best is not None:
        value = percent(best.median["control"])
        found.append(Tile("Best baseline, control set", value, f"{best.name}; median, eq. 20"))
    if times is not None:
        found.append(Tile("Advantage", scientific(times), "times smaller, of the two medians"))
    return found


def panda_tiles(panda: PandaResults) -> list[Tile]:
    """Key figures of section IV.B, those that there are."""
    after, ratio = measured(panda.stated, "lambda_converged_s"), last_ratio(panda)
    value = "not reached" if after is None else with_unit(after, "s", 3)
    found = [Tile("λ of the Panda converged", value, "after the first motion")]
    if ratio is not None:
        found.append(
            Tile("Torque error at the end", scientific(ratio, 3), "times batch least squares")
        )
    return found


def _atlas(atlas: AtlasResults) -> dict[str, Any]:
    letters = string.ascii_lowercase
    skeletons = trees.epoch_panels(atlas, letters)
    histogram = panels.histogram_panel(atlas, letters[max(len(skeletons), trees.PAPER_EPOCHS + 1)])
    paper, others = panels.arm_panels(atlas)
    summary = panels.side_by_side(atlas)
    return {
        "n": atlas.tree.n,
        "limbs": trees.limb_key(atlas.tree),
        "schema": [*skeletons, *([histogram] if histogram else [])],
        "schema_more": panels.schema_panels(atlas),
        "paper": paper,
        "whole": panels.whole_panels(atlas),
        "others": others,
        "last": [trees.arm_panel(atlas), *([summary] if summary else [])],
        "arm": f"{atlas.arm[0] + 1} to {atlas.arm[-1] + 1}",
        "stated": tables.stated_table(atlas.stated),
        "learners": tables.learner_table(atlas),
        "tuning": tables.tuning_rows(atlas),
    }


def _panda(panda: PandaResults) -> dict[str, Any]:
    torque = convergence.torque_panel(panda)
    return {
        "joints": [(j % JOINT_COLORS + 1, name) for j, name in enumerate(panda.tree.joint_names)],
        "lambda": convergence.lambda_panels(panda),
        "theta": [*convergence.theta_panels(panda), *([torque] if torque else [])],
        "logarithmic": convergence.logarithmic(panda),
        "stated": tables.stated_table(panda.stated),
    }


def _atlas_reasons(atlas: AtlasResults) -> list[str]:
    """What of Figs. 4 and 5 is missing, and why."""
    reasons = []
    if not atlas.snapshots:
        reasons.append("Fig. 4a-d: no epochs of λ's training were kept.")
    if not any(sum(counts) for counts in atlas.error_counts.values()):
        reasons.append("Fig. 4f: no kinematic errors were counted.")
    have = {letter(learner) for learner in atlas.learners if learner.boxes}
    for which, name in PAPER_LEARNERS:
        if which not in have:
            reasons.append(f"Fig. 5{which}: {name} was not run.")
    return reasons


def _panda_reasons(panda: PandaResults) -> list[str]:
    """What of Fig. 6 is missing, and why."""
    if math.isfinite(panda.theta_start_s):
        return []
    return ["Fig. 6b: θ was not learned, it waits until λ has converged."]
