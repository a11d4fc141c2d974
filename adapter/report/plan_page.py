"""The page of a plan: where a motion goes, before it is one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from adapter.control.excitation import plan_lines
from adapter.control.free_path import ArmInCell, Clearance
from adapter.control.limits import MotionLimits
from adapter.control.path_motion import PathMotion
from adapter.control.settings import Box, Cell, Mesh
from adapter.control.shapes import read_mesh
from adapter.model.spatial import Array, matrix_from_rpy
from adapter.report.html import fill, write_whole
from adapter.report.next_steps import Step
from adapter.report.skeleton import Projection, from_a_corner, ground
from adapter.report.style import ACCENT, GOAL, GRID, INK, MUTED, Drawing, Panel, joint_color

POSES = 80  # drawn along the path
RIM = 24  # corners of a circle
VIEWS: tuple[tuple[str, Projection, str], ...] = (
    ("Seen from a corner", from_a_corner, "grey: where links go; blue: start; orange: nearest"),
    ("Seen from the side", lambda points: points[..., [0, 2]], "x to the right, z up"),
    ("Seen from above", lambda points: points[..., [0, 1]], "x to the right, y up"),
)


class Plan(NamedTuple):
    """A motion in its cell, and what it comes nearest to."""

    arm: ArmInCell
    motion: PathMotion
    limits: MotionLimits
    nearest: Clearance

    def lines(self, duration_s: float, more: Sequence[str] = ()) -> list[str]:
        """Where it goes, with what it comes nearest to and more of its kind before the last."""
        names = self.arm.model.tree.joint_names
        lines = plan_lines(self.motion, self.limits, names, duration_s)
        nearest = f"Nearest on the way: {self.nearest} (margin {self.arm.cell.margin:g} m)."
        return [*lines[:-1], nearest, *more, lines[-1]]

    def write(self, path: Path, lines: Sequence[str], steps: Sequence[Step] = ()) -> Path:
        """Write its page with these lines and what to do next. Raises RunFolderError."""
        arm, motion, limits, nearest = self
        start, closest = motion.q, motion.path(nearest.path_s)[0].copy()
        span_s = max(nearest.path_s, 30.0)
        # the golden section spreads them without a step that a period could share
        poses = [motion.path(span_s * (k * 0.618034 % 1.0))[0].copy() for k in range(POSES)]
        names, margin = arm.model.tree.joint_names, arm.cell.margin
        of_joints = [line for line in lines if line.startswith(names)]
        context: dict[str, Any] = {
            "robot": arm.model.name,
            "nearest": f"{nearest} after {nearest.path_s:.1f} s of path, margin {margin:g} m",
            "ignored": [" and ".join(pair) for pair in arm.ignored],
            "views": [_view(arm, poses, closest, start, view) for view in VIEWS],
            "joints": _joint_panels(motion, limits, names),
            "lines": [line for line in lines if line not in of_joints],
            "of_joints": of_joints,
            "steps": steps,
        }
        return write_whole(path, fill("plan.html", context))


def _view(
    arm: ArmInCell,
    poses: Sequence[Array],
    nearest: Array,
    start: Array,
    view: tuple[str, Projection, str],
) -> Panel:
    title, project, note = view
    drawing = Drawing("third", bare=True, stretch=1.3)
    ax = drawing.axes[0]
    for outline in _outlines(arm.cell):
        ax.plot(*project(outline).T, color=GOAL, linewidth=0.8)
    for q, color, width, alpha in (
        *((q, MUTED, 2.5, 0.08) for q in poses),
        (start, ACCENT, 2.2, 1.0),
        (nearest, GOAL, 1.4, 1.0),
    ):
        for ends in arm.skeleton(q) if alpha == 1.0 else ():
            ax.plot(*project(ends).T, color=color, linewidth=0.7)
        for ends, _ in arm.placed(q):
            line = _rim(project(ends))
            ax.plot(*line.T, color=color, linewidth=width, alpha=alpha, solid_capstyle="round")
    ground(ax, project, 0.6 * arm.cell.table)
    return drawing.panel(title, "", note)


def _rim(points: Array) -> Array:
    """Points (k, 2) of a body as a line: a capsule's as they are, the outline of more."""
    if len(points) <= 2:
        return points
    try:
        around = ConvexHull(points).vertices
    except QhullError:
        return points
    return points[[*around, around[0]]]


def _outlines(cell: Cell) -> list[Array]:
    """Lines (k, 3) that show a cell's boxes and cylinders, boxes around its meshes, and a piece of
    each plane."""
    loop = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]], dtype=float)
    found, corners = [], np.vstack([np.c_[loop, np.full(5, z)] for z in (-1.0, 1.0)])
    things: list[Box | Mesh] = [*cell.box, *cell.mesh]
    for thing in things:
        middle, half = np.zeros(3), np.zeros(3)
        if isinstance(thing, Box):
            half = 0.5 * np.array(thing.size)
        else:
            at = read_mesh(thing.file, (thing.scale,)).corners
            middle, half = 0.5 * (at.min(axis=0) + at.max(axis=0)), 0.5 * np.ptp(at, axis=0)
        around = middle + corners * half
        found.append(np.array(thing.xyz) + around @ matrix_from_rpy(thing.rpy).T)
    angle = np.linspace(0.0, 2.0 * np.pi, RIM)
    for each in cell.cylinder:
        ring = each.radius * np.c_[np.cos(angle), np.sin(angle)]
        ends = [np.c_[ring, np.full(RIM, z)] for z in (-0.5 * each.length, 0.5 * each.length)]
        found.append(np.array(each.xyz) + np.vstack(ends) @ matrix_from_rpy(each.rpy).T)
    for plane in cell.plane:
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        across = np.linalg.svd(normal[None])[2][1:]
        found.append(plane.offset * normal + 0.8 * loop @ across)
    return found


def _joint_panels(motion: PathMotion, limits: MotionLimits, names: Sequence[str]) -> list[Panel]:
    """Ranges against limits, and speeds as shares of theirs."""
    lower, upper, speed, acceleration, jerk = motion.bounds()
    ranges, shares = Drawing("half"), Drawing("half")
    fastest = limits.speed_between(lower, upper)
    at = np.arange(len(names))
    for j in range(len(names)):
        ends = [limits.lower[j], limits.upper[j]]
        ranges.axes[0].plot(ends, [j, j], color=GRID, linewidth=7.0, solid_capstyle="butt")
        ends, own = [lower[j], upper[j]], joint_color(j)
        ranges.axes[0].plot(ends, [j, j], color=own, linewidth=4.0, solid_capstyle="butt")
    parts = speed / fastest, acceleration / limits.acceleration, jerk / limits.jerk
    for k, (part, color) in enumerate(zip(parts, (ACCENT, MUTED, INK), strict=True)):
        shares.axes[0].barh(at + 0.25 * (k - 1), 100.0 * part, 0.22, color=color)
    for drawing in (ranges, shares):
        drawing.axes[0].set_yticks(at, list(names), parse_math=False)
        drawing.axes[0].invert_yaxis()
        drawing.figure.subplots_adjust(left=0.24)
    said = "blue speed, grey acceleration, black jerk"
    where = ranges.panel("Ranges", "rad", "grey: the limits")
    return [where, shares.panel("Shares of the limits", "%", said)]
