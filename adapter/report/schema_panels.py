"""Panels of the body schema λ over time: its values, and its errors where they are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.model.spatial import Array, log_rotation, matrix_from_zxz
from adapter.report.style import (
    Drawing,
    Panel,
    joint_color,
    level,
    lines_by_joint,
    log_axis,
    log_time,
    mark,
    named,
    thin_rows,
    time_axis,
)
from adapter.runs.run_folder import RunData
from adapter.runs.score import POSITION_GOAL_M, ROTATION_GOAL_RAD

DASHES: Sequence[tuple[float, Sequence[float]]] = ((0, ()), (0, (4, 1.5)), (0, (1, 1.3)))  # x, y, z
SHOWN_S, SHOWN_FACTOR = 3.0, 2.5  # values: so long, or so many times the time to converge
FIRST_S = 0.05  # left end of a logarithmic time axis
LOWEST = 1e-5  # rad, m; of an error that is shown; below it a line leaves the panel
SETTLED = "inside both goals"


def schema_panels(data: RunData) -> list[Panel]:
    """λ over time (the paper's Fig. 6a), and its errors where there is a reference."""
    t = data.times(data.schema_trace)
    lam = data.schema_trace[:, 1:].reshape(-1, data.n, 6)
    if len(t) < 2:
        return []
    converged = data.converged_s("lambda")
    # most happens at first: values are shown up to here, errors to the end
    until = t[-1] if converged is None else min(t[-1], max(SHOWN_S, SHOWN_FACTOR * converged))
    early, values = thin_rows(t[t <= until], lam[t <= until])
    shown = "" if until == t[-1] else f"; the first {until:.2g} of {t[-1]:.3g} s"
    note = f"in its parent's, x solid, y dashed, z dotted{shown}"
    turns, shifts = rotation_path(values), values[..., 3:]
    panels = [
        _components(early, turns, converged).panel(
            "Orientation of the joint frames", "rad", f"rotation vector of each frame {note}"
        ),
        _components(early, shifts, converged).panel(
            "Position of the joint frames", "m", f"origin of each frame {note}"
        ),
    ]
    if data.reference is None:
        return panels
    goals = (ROTATION_GOAL_RAD, "rad"), (POSITION_GOAL_M, "m")
    titles = "Orientation error", "Position error"
    for title, error, (goal, unit) in zip(titles, data.schema_errors, goals, strict=True):
        drawing = _errors(t, error, goal, unit, converged)
        panels.append(drawing.panel(title, unit, "in what the data had shown by then"))
    return panels


def rotation_path(lam: Array) -> Array:
    """Rotation vectors (k, n, 3) of λ (k, n, 6) over time, without jumps at half a turn.

    A rotation by a about u is one by a - 2π about u too; the one nearer to the row before is
    taken.
    """
    path = log_rotation(matrix_from_zxz(lam[..., :3]))
    for k in range(1, len(path)):
        length = np.linalg.norm(path[k], axis=-1, keepdims=True)
        other = path[k] * (1.0 - 2.0 * np.pi / np.maximum(length, 1e-9))
        stay, turn = (np.linalg.norm(x - path[k - 1], axis=-1) for x in (path[k], other))
        path[k] = np.where(((turn < stay) & (length[..., 0] > 1e-6))[..., None], other, path[k])
    return path


def _components(t: Array, values: Array, converged: float | None) -> Drawing:
    """Values (k, n, 3): a colour per joint, a dash per axis."""
    drawing = Drawing("half")
    ax = drawing.axes[0]
    for j in range(values.shape[1]):
        for axis, dashes in enumerate(DASHES):
            name = named(f"joint {j + 1} {'xyz'[axis]}")
            (line,) = ax.plot(t, values[:, j, axis], gid=name, color=joint_color(j), linewidth=1.0)
            line.set_linestyle(dashes)
    ax.set_xlim(min(0.0, t[0]), t[-1])
    ax.margins(y=0.12)  # room for the words of the mark
    mark(ax, converged, SETTLED)
    time_axis(drawing)
    return drawing


def _errors(t: Array, error: Array, goal: float, unit: str, converged: float | None) -> Drawing:
    """Errors (k, n) on logarithmic axes, with their goal."""
    drawing = Drawing("half")
    ax = drawing.axes[0]
    top = max(float(error.max()), 10 * goal)
    shown = t >= FIRST_S
    lines_by_joint(ax, t[shown], np.maximum(error[shown], 1e-3 * LOWEST))
    log_axis(ax, LOWEST, 2 * top)
    log_time(ax, FIRST_S, t[-1])
    late = converged is None or converged > 0.2 * t[-1]  # then lines cross the right end
    level(ax, goal, f"goal {goal:g} {unit}", left=late)
    mark(ax, converged, SETTLED)
    time_axis(drawing)
    return drawing
