"""A tree as a skeleton: where λ puts its joints, coloured limb by limb (paper, Figs. 4a-e, 5e)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from adapter.experiment.results import AtlasResults
from adapter.report.experiment_words import with_unit
from adapter.report.skeleton import Skeleton
from adapter.report.style import (
    ACCENT,
    INK,
    JOINT_COLORS,
    MUTED,
    SIZES,
    Drawing,
    Panel,
    joint_color,
)
from adapter.spatial import Array, matrix_from_zxz
from adapter.tree import BASE, Tree

TURN, LIFT = np.radians(-28.0), np.radians(14.0)  # seen from the front, its right, and above
STRETCH = 1.3  # a skeleton's height, of the usual
# The paper's letters, by label: a run too short for an epoch must not move the others' letters.
EPOCH_LETTERS = {"epoch 0": "a", "epoch 50": "b", "epoch 100": "c", "final": "d"}
MARGIN = 1.12  # times what is shown
SCALES_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
SCALE_SHARE = 0.25  # of a picture's height that a scale may take
SIDES = {"l": "left", "r": "right"}


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


def limb_key(tree: Tree) -> list[tuple[int, str]]:
    """Colour (1 to 8, as the page names it) and name of each limb."""
    return [(limb.color % JOINT_COLORS + 1, limb.name) for limb in limbs(tree)]


def skeleton(tree: Tree, lam: Array) -> Skeleton:
    """Joint origins and axes in the base's frame, all joint angles zero, of λ (n, 6).

    Raises:
        ValueError: λ of another shape, or not finite.
    """
    lam = np.asarray(lam, dtype=float)
    if lam.shape != (tree.n, 6) or not np.isfinite(lam).all():
        raise ValueError(f"a skeleton needs finite λ ({tree.n}, 6), got shape {lam.shape}")
    turns = matrix_from_zxz(lam[:, :3])
    R, p = np.zeros((tree.n, 3, 3)), np.zeros((tree.n, 3))
    for j, i in enumerate(tree.parent):
        R_i, p_i = (np.eye(3), np.zeros(3)) if i == BASE else (R[i], p[i])
        R[j], p[j] = R_i @ turns[j], p_i + R_i @ lam[j, 3:]
    return Skeleton(p, R[:, :, 2], {})


def epoch_panels(atlas: AtlasResults) -> list[Panel]:
    """λ of each epoch kept, then the actual one (Fig. 4a-e)."""
    tree, actual = atlas.tree, skeleton(atlas.tree, atlas.true_lam)
    panels = []
    for label, lam in atlas.snapshots:
        shown = skeleton(tree, lam)
        off = float(np.linalg.norm(shown.p - actual.p, axis=1).max())
        drawing = Drawing("third", bare=True, stretch=STRETCH)
        _bones(drawing.axes[0], tree, actual, behind=True)
        _bones(drawing.axes[0], tree, shown)
        _frame(drawing, [shown, actual])
        note = f"joint origins off by up to {with_unit(off, 'm')}; grey: the actual ones"
        which = EPOCH_LETTERS.get(label)
        title = f"{label[:1].upper()}{label[1:]}"
        panels.append(drawing.panel(f"({which}) {title}" if which else title, "", note))
    drawing = Drawing("third", bare=True, stretch=STRETCH)
    _bones(drawing.axes[0], tree, actual)
    _frame(drawing, [actual])
    return [*panels, drawing.panel(f"(e) Actual {tree.n}-joint robot", "", "true λ")]


def arm_panel(atlas: AtlasResults) -> Panel:
    """The robot with the joints highlighted that the baselines learn (Fig. 5e)."""
    tree, actual = atlas.tree, skeleton(atlas.tree, atlas.true_lam)
    drawing = Drawing("half", bare=True, stretch=STRETCH)
    _bones(drawing.axes[0], tree, actual, only=atlas.arm)
    _frame(drawing, [actual])
    first, last = atlas.arm[0], atlas.arm[-1]
    names = f"{tree.joint_names[first]} to {tree.joint_names[last]}"
    title = f"(e) What the baselines learn: joints {first + 1} to {last + 1}"
    return drawing.panel(title, "", f"{names}, numbered from 1 in the tree's order")


def _bones(
    ax: Axes,
    tree: Tree,
    shown: Skeleton,
    behind: bool = False,
    only: Sequence[int] | None = None,
) -> None:
    """Lines from each parent's origin to the joint's, and a dot there."""
    color = {j: joint_color(limb.color) for limb in limbs(tree) for j in limb.joints}
    for j, line in enumerate(shown.bones(tree)):
        ends = _projected(line).T
        if behind:
            ax.plot(*ends, color=MUTED, linewidth=6.0, alpha=0.25, solid_capstyle="round")
            continue
        marked = only is None or j in only
        stroke = color[j] if only is None else ACCENT if marked else MUTED
        wide = 2.2 if only is None else 3.4 if marked else 1.6
        faint = 1.0 if marked else 0.55
        ax.plot(*ends, color=stroke, linewidth=wide, alpha=faint, solid_capstyle="round")
        dot = ends[:, 1:]
        ax.plot(*dot, color=stroke, marker="o", markersize=3.4, alpha=faint, linestyle="none")
    if not behind:
        ax.plot(*_projected(np.zeros((1, 3))).T, color=INK, marker="s", markersize=4.4)


def _projected(points: Array) -> Array:
    """Points (..., 3) in the drawing plane (..., 2), by parallel projection."""
    right = np.array([-np.sin(TURN), np.cos(TURN), 0.0])
    towards = np.array([np.cos(TURN), np.sin(TURN), 0.0])
    up = np.array([0.0, 0.0, np.cos(LIFT)]) - np.sin(LIFT) * towards
    return np.stack([points @ right, points @ up], axis=-1)


def _frame(drawing: Drawing, shown: Sequence[Skeleton]) -> None:
    """Limits that hold everything at equal scales, and how long a metre is."""
    ax = drawing.axes[0]
    flat = _projected(np.vstack([np.zeros((1, 3)), *(x.p for x in shown)]))
    low, high = flat.min(axis=0), flat.max(axis=0)
    width, height, text = SIZES[drawing.size]
    ratio = width / (height * STRETCH)
    half = 0.5 * MARGIN * max(float((high - low)[1]), float((high - low)[0]) / ratio, 1e-6)
    x, y = 0.5 * (low + high)
    ax.set_xlim(x - ratio * half, x + ratio * half)
    ax.set_ylim(y - half, y + half)
    fits = [s for s in SCALES_M if s <= SCALE_SHARE * 2.0 * half]
    scale = fits[-1] if fits else SCALES_M[0]
    left, foot = x - 0.97 * ratio * half, y - 0.95 * half
    ax.plot([left, left + scale], [foot, foot], color=MUTED, linewidth=1.4)
    ax.text(
        left + scale + 0.03 * half, foot, f"{scale:g} m", color=MUTED, va="center", fontsize=text
    )
