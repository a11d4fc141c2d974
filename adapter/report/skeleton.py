"""The arm as a skeleton: where initial, learned and documented λ put the joints in one posture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from adapter.model.self_model import FixedFrame
from adapter.model.spatial import Array, matrix_from_zxz
from adapter.model.tree import BASE, Tree
from adapter.physics.kernels import place_frames, placed
from adapter.report.style import ACCENT, GOAL, GRID, INK, MUTED, Drawing, Panel, joint_color
from adapter.runs.run_folder import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Projection = Callable[[Array], Array]  # points (..., 3) to the drawing plane (..., 2)
STYLES: dict[str, dict[str, Any]] = {
    "documented": {"color": MUTED, "linewidth": 8.0, "alpha": 0.3},
    "learned": {"color": ACCENT, "linewidth": 2.4},
    "reference": {"color": GOAL, "linewidth": 1.0, "linestyle": (0, (4, 2))},
    "initial": {"color": INK, "linewidth": 1.2, "linestyle": (0, (1, 1.2))},
}
SCALE_M = 0.2


@dataclass(frozen=True)
class Skeleton:
    """Joint origins p (n, 3), joint axes (n, 3), and tips of the outermost links by link."""

    p: Array
    axis: Array
    tips: dict[int, Array]

    def bones(self, tree: Tree) -> list[Array]:
        """Lines (2, 3) from each joint's parent to the joint, and on to the tips."""
        starts = [np.zeros(3) if i == BASE else self.p[i] for i in tree.parent]
        lines = [np.stack(ends) for ends in zip(starts, self.p, strict=True)]
        return lines + [np.stack([self.p[j], tip]) for j, tip in self.tips.items()]


def skeleton_panels(data: RunData) -> list[Panel]:
    """The arm as initial, learned, documented (and true) λ have it, from three sides."""
    q = posture(data)
    arms = {
        "documented": placed_arm(data, data.documented.lam, q),
        "initial": replace(placed_arm(data, data.start_lam, q), tips={}),  # all in one place
        "learned": placed_arm(data, data.model.lam, q),
    }
    if data.reference is not None and has_reference(data):
        arms["reference"] = placed_arm(data, data.reference, q)
    views: tuple[tuple[str, Projection, str], ...] = (
        ("Seen from a corner", from_a_corner, "short ticks are the joint axes"),
        ("Seen from the side", lambda points: points[..., [0, 2]], "x to the right, z up"),
        ("Seen from the front", lambda points: points[..., [1, 2]], "y to the right, z up"),
    )
    tree = data.documented.tree
    return [_view(tree, arms, project, title, note) for title, project, note in views]


def has_reference(data: RunData) -> bool:
    """Whether errors are against something else than the documentation, so that it is drawn."""
    reference = data.reference
    return reference is not None and not np.allclose(reference, data.documented.lam, atol=1e-9)


def posture(data: RunData) -> Array:
    """(n,) rad: of the run's postures the one that spreads widest in all directions of a plane;
    the middle of the joints' ranges where there are none."""
    some = some_postures(data)
    if not len(some):
        limits = data.documented.limits
        return np.nan_to_num(0.5 * (limits.lower + limits.upper), posinf=0.0, neginf=0.0)
    points = [placed_arm(data, data.documented.lam, row).p for row in some]
    spread = [np.linalg.svd(p - p.mean(axis=0), compute_uv=False) for p in points]
    return np.asarray(some[int(np.argmax([s[min(1, len(s) - 1)] for s in spread]))])


def some_postures(data: RunData) -> Array:
    """(k, n) rad: postures of the run, spread over it; none where nothing was kept."""
    q = data.score_signals()[0] if len(data.score_trace) else np.zeros((0, data.n))
    return np.asarray(q[np.linspace(0, len(q) - 1, min(len(q), 60)).astype(int)])


def placed_arm(data: RunData, lam: Array, q: Array) -> Skeleton:
    """The arm of a λ (n, 6) in a posture (n,) rad."""
    arm = data.documented
    return skeleton_of(arm.tree, matrix_from_zxz(lam[:, :3]), lam[:, 3:], q, arm.frames)


def skeleton_of(
    tree: Tree, R0: Array, p0: Array, q: Array, frames: Sequence[FixedFrame] = ()
) -> Skeleton:
    """Where an arm is at q (n,) rad.

    Args:
        R0, p0: (n, 3, 3), (n, 3) m joint frames in their parents' at q = 0.
        frames: that ride on links; the farthest one of an outermost link is its tip.
    """
    R, p = np.empty((tree.n, 3, 3)), np.empty((tree.n, 3))
    place_frames(placed(tree, R0, p0), q, R, p)
    tips = {}
    for j in sorted(set(range(tree.n)) - set(tree.parent)):
        riding = [f.position for f in frames if f.parent == tree.link_names[j]]
        if riding:
            tips[j] = p[j] + R[j] @ max(riding, key=lambda x: float(np.linalg.norm(x)))
    return Skeleton(p, R[:, :, 2], tips)


def from_a_corner(points: Array, turn_deg: float = -55.0, lift_deg: float = 18.0) -> Array:
    """Parallel projection of points (..., 3), by default from the right in front and from above."""
    turn, lift = np.radians(turn_deg), np.radians(lift_deg)
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    towards = np.array([np.cos(turn), np.sin(turn), 0.0])
    up = np.array([0.0, 0.0, np.cos(lift)]) - np.sin(lift) * towards
    return np.stack([points @ right, points @ up], axis=-1)


def _view(
    tree: Tree, arms: dict[str, Skeleton], project: Projection, title: str, note: str
) -> Panel:
    drawing = Drawing("third", bare=True, stretch=1.3)
    ax = drawing.axes[0]
    for name, style in STYLES.items():
        for line in arms[name].bones(tree) if name in arms else ():
            ax.plot(*project(line).T, solid_capstyle="round", **style)
    learned = arms["learned"]
    size = float(np.ptp(np.vstack([arm.p for arm in arms.values()]), axis=0).max())
    for j, (p, axis) in enumerate(zip(learned.p, learned.axis, strict=True)):
        tick = 0.06 * size * axis  # half length, of the arm's size
        ax.plot(*project(np.stack([p - tick, p + tick])).T, color=joint_color(j), linewidth=1.3)
        ax.plot(*project(p), color=joint_color(j), marker="o", markersize=3.6)
    ground(ax, project, 0.15 * size)
    return drawing.panel(title, "", note)


def ground(ax: Axes, project: Projection, half: float) -> None:
    """A square on the ground around the base, `half` (m) to either side, none of 0; a scale."""
    if half:
        square = half * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0], [1, 1, 0]])
        ax.plot(*project(square).T, color=GRID, linewidth=1.2, zorder=0)
    left, foot = ax.get_xlim()[0], ax.get_ylim()[0]
    ax.plot([left, left + SCALE_M], [foot, foot], color=MUTED, linewidth=1.2)
    ax.text(left + 1.1 * SCALE_M, foot, f"{SCALE_M:g} m", color=MUTED, va="center", fontsize=7.6)
