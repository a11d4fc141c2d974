"""Fig. 4: where λ puts the joints while it is learned (a-e), and how far off it is in the end (f).
Fig. 5: the learners' torque errors (a-d), and the arm that the baselines learn (e).

A tree is drawn as a skeleton, coloured limb by limb.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

from adapter.experiments.falls import SETS
from adapter.experiments.page.words import LETTERS, OURS, grouped, with_unit
from adapter.experiments.results import PAPER_BASELINES, AtlasResults, LearnerScores
from adapter.model.spatial import Array, matrix_from_zxz
from adapter.model.tree import BASE, Tree
from adapter.physics.freedom import Freedom
from adapter.report import style
from adapter.report.skeleton import Skeleton, from_a_corner, skeleton_of
from adapter.runs.outcome import frame_errors

VIEW_DEG = (-28.0, 14.0)  # seen from the front, its right, and above
STRETCH = 1.3  # a skeleton's height, of the usual
# The paper's letters, by label: a run too short for an epoch must not move the others' letters.
EPOCH_LETTERS = {"epoch 0": "a", "epoch 50": "b", "epoch 100": "c", "final": "d"}
MARGIN = 1.12  # times what is shown
SCALES_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
SCALE_SHARE = 0.25  # of a picture's height that a scale may take
SIDES = {"l": "left", "r": "right"}
SMALLEST = 1e-16  # of an error in double precision; an exact zero is drawn here
PERCENT = 100.0
KINEMATIC_GOAL = 1e-6  # of |k - k_hat| in SI units; ours, the paper states none
SET_NAMES = {"train": "muted", "test": "accent", "control": "goal"}  # the page's colours
MOST_JOINTS = 16  # in one panel of boxes
LARGEST = 2.0  # of eq. 20: torques of opposite sign
ROOM = 1.2  # times, between what is shown and the end of a logarithmic axis
KINDS = {
    "v": ("velocity", "m/s"),
    "w": ("angular velocity", "rad/s"),
    "a": ("acceleration", "m/s²"),
    "dw": ("angular acceleration", "rad/s²"),
}


@dataclass(frozen=True)
class Limb:
    """A chain of joints between branchings of the tree: its name and its colour's number."""

    name: str
    joints: tuple[int, ...]
    color: int


def limbs(tree: Tree) -> list[Limb]:
    """The chains that the tree's branchings make; a single joint belongs to what it hangs on."""
    chains: list[list[int]] = []
    at: dict[int, int] = {}
    for j, i in enumerate(tree.parent):
        if i == BASE or len(tree.children[i]) > 1:
            chains.append([])
            at[j] = len(chains) - 1
        else:
            at[j] = at[i]
        chains[at[j]].append(j)
    names = [_name([tree.joint_names[j] for j in chain]) for chain in chains]
    for k, chain in enumerate(chains):
        parent = tree.parent[chain[0]]
        if len(chain) == 1 and parent != BASE:
            chains[at[parent]].append(chain[0])
            names[at[parent]] += f" and {names[k]}"
            at[chain[0]], chains[k] = at[parent], []
    kept = [(name, chain) for name, chain in zip(names, chains, strict=True) if chain]
    return [Limb(name, tuple(chain), k) for k, (name, chain) in enumerate(kept)]


def _name(joints: Sequence[str]) -> str:
    """What the joints' names begin with in common: "right arm" of r_arm_shz to r_arm_wry2."""
    parts = [name.split("_")[:-1] for name in joints]
    common = []
    for words in zip(*parts, strict=False):
        if len(set(words)) > 1:
            break
        common.append(SIDES.get(words[0], words[0]))
    if common:
        return " ".join(common)
    return joints[0] if len(joints) == 1 else f"{joints[0]} to {joints[-1]}"


def skeleton(tree: Tree, lam: Array) -> Skeleton:
    """Joint origins and axes in the base's frame, all joint angles zero, of λ (n, 6)."""
    return skeleton_of(tree, matrix_from_zxz(lam[:, :3]), lam[:, 3:], np.zeros(tree.n))


def epoch_panels(atlas: AtlasResults) -> list[style.Panel]:
    """λ of each epoch kept, then the actual one (Fig. 4a-e)."""
    tree, actual = atlas.tree, skeleton(atlas.tree, atlas.true_lam)
    panels = []
    for label, lam in atlas.snapshots:
        shown = skeleton(tree, lam)
        off = float(np.linalg.norm(shown.p - actual.p, axis=1).max())
        drawing = style.Drawing("third", bare=True, stretch=STRETCH)
        draw_bones(drawing.axes[0], tree, actual, behind=True)
        draw_bones(drawing.axes[0], tree, shown)
        fit_to(drawing, [shown, actual])
        note = f"joint origins off by up to {with_unit(off, 'm')}; grey: the actual ones"
        which = EPOCH_LETTERS.get(label)
        title = f"{label[:1].upper()}{label[1:]}"
        panels.append(drawing.panel(f"({which}) {title}" if which else title, "", note))
    drawing = style.Drawing("third", bare=True, stretch=STRETCH)
    draw_bones(drawing.axes[0], tree, actual)
    fit_to(drawing, [actual])
    return [*panels, drawing.panel(f"(e) Actual {tree.n}-joint robot", "", "true λ")]


def draw_bones(
    ax: Axes, tree: Tree, shown: Skeleton, behind: bool = False, only: Sequence[int] | None = None
) -> None:
    """Lines from each parent's origin to the joint's, and a dot there."""
    color = {j: style.joint_color(limb.color) for limb in limbs(tree) for j in limb.joints}
    for j, line in enumerate(shown.bones(tree)):
        ends = from_a_corner(line, *VIEW_DEG).T
        if behind:
            ax.plot(*ends, color=style.MUTED, linewidth=6.0, alpha=0.25, solid_capstyle="round")
            continue
        marked = only is None or j in only
        stroke = color[j] if only is None else style.ACCENT if marked else style.MUTED
        wide = 2.2 if only is None else 3.4 if marked else 1.6
        faint = 1.0 if marked else 0.55
        ax.plot(*ends, color=stroke, linewidth=wide, alpha=faint, solid_capstyle="round")
        dot = ends[:, 1:]
        ax.plot(*dot, color=stroke, marker="o", markersize=3.4, alpha=faint, linestyle="none")
    if not behind:
        base = from_a_corner(np.zeros((1, 3)), *VIEW_DEG).T
        ax.plot(*base, color=style.INK, marker="s", markersize=4.4)


def fit_to(drawing: style.Drawing, shown: Sequence[Skeleton]) -> None:
    """Limits that hold everything at equal scales, and how long a metre is."""
    ax = drawing.axes[0]
    flat = from_a_corner(np.vstack([np.zeros((1, 3)), *(x.p for x in shown)]), *VIEW_DEG)
    low, high = flat.min(axis=0), flat.max(axis=0)
    width, height, text = style.SIZES[drawing.size]
    ratio = width / (height * STRETCH)
    half = 0.5 * MARGIN * max(float((high - low)[1]), float((high - low)[0]) / ratio, 1e-6)
    x, y = 0.5 * (low + high)
    ax.set_xlim(x - ratio * half, x + ratio * half)
    ax.set_ylim(y - half, y + half)
    fits = [s for s in SCALES_M if s <= SCALE_SHARE * 2.0 * half]
    scale = fits[-1] if fits else SCALES_M[0]
    left, foot = x - 0.97 * ratio * half, y - 0.95 * half
    ax.plot([left, left + scale], [foot, foot], color=style.MUTED, linewidth=1.4)
    left += scale + 0.03 * half
    ax.text(left, foot, f"{scale:g} m", color=style.MUTED, va="center", fontsize=text)


def histogram_panels(atlas: AtlasResults) -> tuple[style.Panel, style.Panel]:
    """Kinematic errors of the networks' λ (Fig. 4f) and of the moments'."""
    error, edges = "errors |k − k̂|", atlas.error_edges
    on = f"the {grouped(atlas.numbers['learned_samples'])} samples"
    note = f"λ of (d), from mini-batches, on {on} it learned from"
    own = _histogram(edges, atlas.error_counts, f"(f) Kinematic {error}", note)
    note = "on the same samples; “FOPnet, moments” takes this λ"
    return own, _histogram(edges, atlas.moments_error_counts, f"λ from moments: {error}", note)


def _histogram(edges: Array, by_kind: Mapping[str, Array], title: str, note: str) -> style.Panel:
    """How large the kinematic errors are, by kind; `edges` (bins + 1,) are logarithms."""
    counts = {kind: np.asarray(c, float) for kind, c in by_kind.items() if sum(c) > 0.0}
    drawing = style.Drawing("third", stretch=STRETCH)
    ax = drawing.axes[0]
    for k, (kind, values) in enumerate(counts.items()):
        name, unit = KINDS[kind]
        share = PERCENT * values / values.sum()
        label, color = f"{name} {kind}, {unit}", style.joint_color(k)
        ax.stairs(share, 10.0**edges, color=color, fill=True, alpha=0.18)
        ax.stairs(share, 10.0**edges, color=color, linewidth=1.2, label=label)
    # A logarithmic x axis around what is counted, with the goal in it.
    used = np.flatnonzero(sum(counts.values()))
    first, last = 10.0 ** (edges[used[0]] - 0.5), 10.0 ** (edges[used[-1] + 1] + 0.5)
    ax.set_xscale("log")
    ax.set_xlim(min(first, 0.25 * KINEMATIC_GOAL), max(last, 4.0 * KINEMATIC_GOAL))
    style.log_ticks(ax.xaxis, LogLocator(10, numticks=7), style.power_of_ten)
    ax.set_ylim(0.0, 1.5 * ax.dataLim.y1)  # room for the legend, which the goal must not cross
    low, high = np.log10(ax.get_xlim())
    side = "right" if np.log10(KINEMATIC_GOAL) < 0.5 * (low + high) else "left"
    style.legend(ax, loc=f"upper {side}", ncols=1, handlelength=1.2, borderaxespad=0.1)
    style.mark(ax, KINEMATIC_GOAL, "goal", top=0.6)
    style.time_axis(drawing, "size of the error, in the unit of its kind")
    most = int(max(values.sum() for values in counts.values()))
    return drawing.panel(title, "% of their kind", f"{note}; {grouped(most)} numbers of a kind")


def schema_panels(atlas: AtlasResults) -> list[style.Panel]:
    """λ's cost while it is learned, and its error at the epochs of the pictures."""
    cost = atlas.cost
    good = np.isfinite(cost) & (cost > 0.0)
    drawing = style.Drawing("third", stretch=STRETCH)
    ax = drawing.axes[0]
    line = style.thin(np.flatnonzero(good).astype(float), cost[good])
    ax.plot(*line, color=style.ACCENT, linewidth=1.2)
    style.log_axis(ax, 0.3 * cost[good].min(), 3.0 * cost[good].max())
    ax.set_xlim(0.0, 1.04 * len(cost))
    style.time_axis(drawing, "step of the optimiser")
    panel = drawing.panel("Cost of λ, eq. 18", "m²/s² + rad²/s²", "mean over the joints")
    return [panel, _epoch_errors(atlas)]


def _epoch_errors(atlas: AtlasResults) -> style.Panel:
    """One dot per joint: how far its frame is from the actual one in its parent's."""
    n = atlas.tree.n
    lam = np.stack([lam for _, lam in atlas.snapshots])
    off = np.maximum(frame_errors(lam, atlas.true_lam, Freedom.none(n)), SMALLEST)
    drawing = style.Drawing("third", stretch=STRETCH)
    ax = drawing.axes[0]
    at = np.arange(len(lam))[:, None] + np.linspace(-0.13, 0.13, n)
    for k, (name, errors) in enumerate(zip(("turn, rad", "shift, m"), off, strict=True)):
        side, color = -0.18 + 0.36 * k, (style.ACCENT, style.GOAL)[k]
        dots = (at + side).ravel(), errors.ravel(), "o"
        ax.plot(*dots, markersize=2.6, color=color, alpha=0.75, label=name)
    style.log_axis(ax, 0.3 * off.min(), 5.0 * off.max())
    style.categories(ax, [label for label, _ in atlas.snapshots])
    style.legend(ax, loc="best")
    return drawing.panel("Error of λ in the pictures", "rad, m", "one dot per joint")


def arm_rows(atlas: AtlasResults, learner: LearnerScores) -> dict[str, Array]:
    """By set the boxes (arm joints, 5) of a learner of the whole tree or of the arm alone."""
    whole, arm = atlas.tree.n, list(atlas.arm)
    return {k: rows[arm] if len(rows) == whole else rows for k, rows in learner.boxes.items()}


def arm_panels(atlas: AtlasResults) -> tuple[list[style.Panel], list[style.Panel]]:
    """Relative errors of the arm's joints, a panel per learner: the paper's four, then others."""
    known = [x for x in atlas.learners if x.name in PAPER_BASELINES]
    shared = _limits(*(box for x in known for box in arm_rows(atlas, x).values()))
    paper: list[tuple[str, style.Panel]] = []
    others: list[style.Panel] = []
    for learner in atlas.learners:
        rows = arm_rows(atlas, learner)
        which = LETTERS.get(learner.name)
        limits = shared if learner in known else _limits(*rows.values())
        if limits is None:
            continue
        drawing = _boxes(rows, atlas.arm, limits)
        if which:
            title, note = f"({which}) {learner.name}", learner.title
            paper.append((which, drawing.panel(title, "relative error, %", note)))
        else:
            others.append(drawing.panel(learner.name, "relative error, %", learner.title))
    return [panel for _, panel in sorted(paper, key=lambda x: x[0])], others


def arm_panel(atlas: AtlasResults) -> style.Panel:
    """The robot with the joints highlighted that the baselines learn (Fig. 5e)."""
    tree, actual = atlas.tree, skeleton(atlas.tree, atlas.true_lam)
    drawing = style.Drawing("half", bare=True, stretch=STRETCH)
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


def whole_panels(atlas: AtlasResults) -> list[style.Panel]:
    """FOPnet's relative errors of all joints, in as many panels as they need."""
    ours = atlas.learners[0]
    limits = _limits(*ours.boxes.values())
    if limits is None:
        return []
    count = -(-atlas.tree.n // MOST_JOINTS)
    panels = []
    for joints in np.array_split(np.arange(atlas.tree.n), count):
        part = joints.tolist()
        drawing = _boxes({name: rows[part] for name, rows in ours.boxes.items()}, part, limits)
        title = f"(d) {OURS}, joints {part[0] + 1} to {part[-1] + 1}"
        panels.append(drawing.panel(title, "relative error, %"))
    return panels


def side_by_side(atlas: AtlasResults) -> style.Panel | None:
    """Median and 99th percentile of every learner on one scale; None where no torque was judged."""
    limits = _limits(*([*x.median.values(), *x.p99.values()] for x in atlas.learners))
    if limits is None:
        return None
    drawing = style.Drawing("half", stretch=STRETCH)
    ax = drawing.axes[0]
    for k, learner in enumerate(atlas.learners):
        for side, name in zip((-0.2, 0.0, 0.2), SETS, strict=True):
            errors = learner.median[name], learner.p99[name]
            middle, high = PERCENT * np.maximum(errors, SMALLEST)
            color = style.STAND_IN[SET_NAMES[name]]
            ax.plot([k + side] * 2, [middle, high], color=color, linewidth=2.0, alpha=0.45)
            ax.plot([k + side], [middle], "o", color=color, markersize=4.5)
            ax.plot([k + side], [high], "_", color=color, markersize=7)
    style.log_axis(ax, *limits)
    style.categories(ax, [x.name for x in atlas.learners])
    note = "dot: median; bar up to the 99th percentile, over all joints that the learner has"
    return drawing.panel("All learners on one scale", "relative error, %", note)


def _limits(*tables: Array | list[float]) -> tuple[float, float] | None:
    """Whole decades in per cent, with some room, around all finite values; None without any."""
    values = np.concatenate([np.zeros(0), *map(np.ravel, tables)])
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low = PERCENT * max(float(values.min()), SMALLEST) / ROOM
    high = PERCENT * min(max(float(values.max()), SMALLEST), LARGEST) * ROOM
    top = 10.0 ** np.ceil(np.log10(high))
    return 10.0 ** np.floor(np.log10(low)), min(top, ROOM * PERCENT * LARGEST)


def _boxes(
    rows: Mapping[str, Array], joints: Sequence[int], limits: tuple[float, float]
) -> style.Drawing:
    """Boxes (joints, 5) of each set beside each other, joint by joint."""
    drawing = style.Drawing("half")
    ax = drawing.axes[0]
    width = 0.72 / len(SETS)
    style.log_axis(ax, *limits)
    for k, name in enumerate(SETS):
        whisker, first, middle, third, end = PERCENT * np.maximum(rows[name], SMALLEST).T
        x = np.arange(len(joints)) + (k - 1.0) * width
        color = style.STAND_IN[SET_NAMES[name]]
        ax.vlines(x, whisker, end, color=color, linewidth=0.9)
        ax.bar(x, third - first, 0.82 * width, first, color=color, alpha=0.4, linewidth=0, zorder=2)
        ax.hlines(middle, x - 0.41 * width, x + 0.41 * width, color=color, linewidth=1.6, zorder=3)
    ax.set_ylim(*limits)
    style.categories(ax, [str(int(j) + 1) for j in joints])
    for before, _ in itertools.pairwise(range(len(joints))):
        ax.axvline(before + 0.5, color=style.STAND_IN["grid"], linewidth=0.6, zorder=0)
    style.time_axis(drawing, "joint")
    return drawing
