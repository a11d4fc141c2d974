"""Fig. 5: the learners' torque errors (a-d), and the arm that the baselines learn (e)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from adapter.experiments.page.figure4 import (
    PERCENT,
    SMALLEST,
    STRETCH,
    draw_bones,
    fit_to,
    skeleton,
)
from adapter.experiments.page.words import OURS, SETS, baselines, fopnet, letter
from adapter.experiments.results import BOX_PERCENTILES, AtlasResults, LearnerScores
from adapter.model.spatial import Array
from adapter.report.style import STAND_IN, Drawing, Panel, categories, log_axis, time_axis

SET_NAMES = {"train": "muted", "test": "accent", "control": "goal"}  # the page's colours
SET_COLORS = {name: STAND_IN[color] for name, color in SET_NAMES.items()}
MOST_JOINTS = 16  # in one panel of boxes
LARGEST = 2.0  # of eq. 20: torques of opposite sign
ROOM = 1.2  # times, between what is shown and the end of a logarithmic axis


def arm_rows(atlas: AtlasResults, learner: LearnerScores) -> dict[str, Array]:
    """By set the boxes (arm joints, 5) of a learner of the whole tree or of the arm alone.

    Raises:
        ValueError: boxes of another number of joints or percentiles.
    """
    found = {}
    for name in SETS:
        if name not in learner.boxes:
            continue
        boxes = np.asarray(learner.boxes[name], dtype=float)
        wanted = {(joints, len(BOX_PERCENTILES)) for joints in (atlas.tree.n, len(atlas.arm))}
        if boxes.shape not in wanted:
            raise ValueError(
                f"{learner.name}, {name}: boxes have shape {boxes.shape}; have: "
                + " or ".join(map(str, sorted(wanted)))
            )
        whole = len(boxes) == atlas.tree.n
        found[name] = boxes[list(atlas.arm)] if whole else boxes
    return found


def arm_panels(atlas: AtlasResults) -> tuple[list[Panel], list[Panel]]:
    """Relative errors of the arm's joints, a panel per learner: the paper's four, then others."""
    shared = _limits(*(box for x in baselines(atlas) for box in arm_rows(atlas, x).values()))
    paper: list[tuple[str, Panel]] = []
    others: list[Panel] = []
    for learner in atlas.learners:
        rows = arm_rows(atlas, learner)
        which = letter(learner)
        limits = shared if which in ("a", "b", "c") else _limits(*rows.values())
        if limits is None:
            continue
        drawing = _boxes(rows, atlas.arm, limits)
        if which:
            title, note = f"({which}) {learner.name}", learner.title
            paper.append((which, drawing.panel(title, "relative error, %", note)))
        else:
            others.append(drawing.panel(learner.name, "relative error, %", learner.title))
    return [panel for _, panel in sorted(paper, key=lambda x: x[0])], others


def arm_panel(atlas: AtlasResults) -> Panel:
    """The robot with the joints highlighted that the baselines learn (Fig. 5e)."""
    tree, actual = atlas.tree, skeleton(atlas.tree, atlas.true_lam)
    drawing = Drawing("half", bare=True, stretch=STRETCH)
    draw_bones(drawing.axes[0], tree, actual, only=atlas.arm)
    fit_to(drawing, [actual])
    first, last = atlas.arm[0], atlas.arm[-1]
    names = f"{tree.joint_names[first]} to {tree.joint_names[last]}"
    title = f"(e) What the baselines learn: joints {first + 1} to {last + 1}"
    return drawing.panel(title, "", f"{names}, numbered from 1 in the tree's order")


def not_judged(atlas: AtlasResults) -> list[int]:
    """Joints (from 0) that no learner has a box of in any set: their torques are too small."""
    judged = np.zeros((2, atlas.tree.n), dtype=bool)  # some learner has the joint; has a box of it
    for learner in atlas.learners:
        for boxes in learner.boxes.values():
            joints = slice(None) if len(boxes) == atlas.tree.n else list(atlas.arm)
            judged[0, joints] = True
            judged[1, joints] |= np.isfinite(boxes).any(axis=1)
    return np.flatnonzero(judged[0] & ~judged[1]).tolist()


def whole_panels(atlas: AtlasResults) -> list[Panel]:
    """FOPnet's relative errors of all joints, in as many panels as they need."""
    ours = fopnet(atlas)
    if ours is None or any(len(ours.boxes.get(s, ())) == len(atlas.arm) for s in SETS):
        return []
    limits = _limits(*ours.boxes.values())
    if limits is None:
        return []
    count = -(-atlas.tree.n // MOST_JOINTS)
    panels = []
    for joints in np.array_split(np.arange(atlas.tree.n), count):
        part = joints.tolist()
        drawing = _boxes({s: ours.boxes[s][part] for s in SETS if s in ours.boxes}, part, limits)
        title = f"(d) {OURS}, joints {part[0] + 1} to {part[-1] + 1}"
        panels.append(drawing.panel(title, "relative error, %"))
    return panels


def side_by_side(atlas: AtlasResults) -> Panel | None:
    """Median and 99th percentile of every learner on one scale; None without any."""
    known = [x for x in atlas.learners if any(s in x.median for s in SETS)]
    values = [v for x in known for v in (*x.median.values(), *x.p99.values())]
    limits = _limits(np.array(values))
    if limits is None:
        return None
    drawing = Drawing("half", stretch=STRETCH)
    ax = drawing.axes[0]
    for k, learner in enumerate(known):
        for side, name in zip((-0.2, 0.0, 0.2), SETS, strict=True):
            middle, high = _shown(learner.median.get(name)), _shown(learner.p99.get(name))
            color = SET_COLORS[name]
            ax.plot([k + side] * 2, [middle, high], color=color, linewidth=2.0, alpha=0.45)
            ax.plot([k + side], [middle], "o", color=color, markersize=4.5)
            ax.plot([k + side], [high], "_", color=color, markersize=7)
    log_axis(ax, *limits)
    categories(ax, [x.name for x in known])
    note = "dot: median; bar up to the 99th percentile, over all joints that the learner has"
    return drawing.panel("All learners on one scale", "relative error, %", note)


def _shown(fraction: float | None) -> float:
    return PERCENT * max(np.nan if fraction is None else fraction, SMALLEST)


def _limits(*tables: Array) -> tuple[float, float] | None:
    """Whole decades in per cent, with some room, around all finite values; None without any."""
    values = np.concatenate([np.ravel(x) for x in tables]) if tables else np.zeros(0)
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low = PERCENT * max(float(values.min()), SMALLEST) / ROOM
    high = PERCENT * min(max(float(values.max()), SMALLEST), LARGEST) * ROOM
    top = 10.0 ** np.ceil(np.log10(high))
    return 10.0 ** np.floor(np.log10(low)), min(top, ROOM * PERCENT * LARGEST)


def _boxes(
    rows: Mapping[str, Array], joints: Sequence[int], limits: tuple[float, float]
) -> Drawing:
    """Boxes (joints, 5) of each set beside each other, joint by joint."""
    drawing = Drawing("half")
    ax = drawing.axes[0]
    width = 0.72 / len(SETS)
    log_axis(ax, *limits)
    for k, name in enumerate(SETS):
        if name not in rows:
            continue
        whisker, first, middle, third, end = PERCENT * np.maximum(rows[name], SMALLEST).T
        x = np.arange(len(joints)) + (k - 1.0) * width
        color = SET_COLORS[name]
        ax.vlines(x, whisker, end, color=color, linewidth=0.9)
        ax.bar(x, third - first, 0.82 * width, first, color=color, alpha=0.4, linewidth=0, zorder=2)
        ax.hlines(middle, x - 0.41 * width, x + 0.41 * width, color=color, linewidth=1.6, zorder=3)
    ax.set_ylim(*limits)
    categories(ax, [str(int(j) + 1) for j in joints])
    for before, _ in itertools.pairwise(range(len(joints))):
        ax.axvline(before + 0.5, color=STAND_IN["grid"], linewidth=0.6, zorder=0)
    time_axis(drawing, "joint")
    return drawing
