"""Fig. 6: how λ and θ of an arm converge."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from adapter.experiments.results import PandaResults
from adapter.model.spatial import Array
from adapter.report.learned_panels import FIRST_S, GROUPS, rotation_path
from adapter.report.style import (
    ACCENT,
    INK,
    MOST_POINTS,
    Drawing,
    Panel,
    joint_color,
    level,
    log_axis,
    log_time,
    mark,
    thin,
    time_axis,
)
from adapter.runs.score import TORQUE_GOAL

TITLES = (
    ("(a) λ: orientation of the joint frames", "rad", slice(0, 3)),
    ("(a) λ: position of the joint frames", "m", slice(3, 6)),
)


def lambda_panels(panda: PandaResults) -> list[Panel]:
    """One line per turn and shift of every joint frame (Fig. 6a), the true values dashed."""
    t, lam = _some(panda, panda.time_s, panda.lam)
    if len(t) < 2:
        return []
    path, true = turns_and_shifts(lam, panda.lam_true)
    panels = []
    for title, unit, part in TITLES:
        drawing = Drawing("half")
        ax = drawing.axes[0]
        for j in range(panda.tree.n):
            for k in range(part.start, part.stop):
                shown = bool(panda.lam_shown[j, k])
                width, alpha = (1.2, 1.0) if shown else (0.7, 0.45)
                ax.plot(t, path[:, j, k], color=joint_color(j), linewidth=width, alpha=alpha)
                if shown:
                    ax.axhline(true[j, k], color=INK, linewidth=0.6, linestyle=(0, (4, 3)))
        _finish(drawing, t, panda)
        what = "rotation vectors" if unit == "rad" else "origins"
        panels.append(drawing.panel(title, unit, f"{what}, x, y and z in the parent's axes"))
    return panels


def theta_panels(panda: PandaResults) -> list[Panel]:
    """One line per inertial parameter of every link (Fig. 6b), by kind."""
    t, theta = _some(panda, panda.theta_time_s, panda.theta)
    if len(t) < 2:
        return []
    panels, titles = [], ("mass", "first moments mX mY mZ", "inertia XX to ZZ")
    for title, (unit, parts) in zip(titles, GROUPS, strict=True):
        drawing = Drawing("half")
        for j in range(panda.tree.n):
            drawing.axes[0].plot(t, theta[:, j, parts], color=joint_color(j), linewidth=1.0)
        _finish(drawing, t, panda)
        panels.append(drawing.panel(f"(b) θ: {title}", unit))
    return panels


def torque_panel(panda: PandaResults) -> Panel | None:
    """Torque error over that of batch least squares; None where θ was not learned."""
    t, ratio = np.asarray(panda.torque_time_s, float), np.asarray(panda.torque_error, float)
    good = np.isfinite(ratio) & (ratio > 0.0) & (t >= _first(panda))
    t, ratio = t[good], ratio[good]
    if len(t) < 2:
        return None
    drawing = Drawing("half")
    ax = drawing.axes[0]
    ax.plot(*thin(t, ratio), color=ACCENT, linewidth=1.3)
    low, high = float(ratio.min()), float(ratio.max())
    if high > 10.0 * low:
        log_axis(ax, 0.7 * min(low, 1.0), 1.5 * high)
    else:
        ax.set_ylim(0.0, 1.15 * max(high, TORQUE_GOAL))
    _finish(drawing, t, panda)
    level(ax, TORQUE_GOAL, f"goal {TORQUE_GOAL:g}", left=False)
    note = "of each sample before it was learned from; 1 is least squares on all samples"
    return drawing.panel("Torque error while learning", "times batch least squares", note)


def logarithmic(panda: PandaResults) -> bool:
    """Whether time is drawn logarithmic: what there is to see comes early."""
    return not panda.theta_start_s > 0.2 * float(panda.time_s[-1])


def _first(panda: PandaResults) -> float:
    """The earliest time that is drawn, s."""
    return FIRST_S if logarithmic(panda) else 0.0


def _some(panda: PandaResults, t: Array, rows: Array) -> tuple[Array, Array]:
    """At most about `MOST_POINTS` finite rows, evenly over the time axis."""
    t, rows = np.asarray(t, float), np.asarray(rows, float)
    good = np.isfinite(rows).reshape(len(rows), -1).all(axis=1) & (t >= _first(panda))
    t, rows = t[good], rows[good]
    if len(t) <= MOST_POINTS:
        return t, rows
    space = np.geomspace if logarithmic(panda) else np.linspace
    keep = np.unique(np.searchsorted(t, space(t[0], t[-1], MOST_POINTS)).clip(0, len(t) - 1))
    return t[keep], rows[keep]


def turns_and_shifts(lam: Array, true: Array) -> tuple[Array, Array]:
    """(k, n, 6) rotation vectors and origins over time, and the true ones (n, 6), of the two
    rotation vectors that mean the same turn the one nearer to what was learned."""
    both = np.concatenate([lam, true[None]])
    path = np.concatenate([rotation_path(both), both[..., 3:]], axis=-1)
    return path[:-1], path[-1]


def _finish(drawing: Drawing, t: Array, panda: PandaResults) -> None:
    ax: Axes = drawing.axes[0]
    if ax.get_yscale() == "linear":
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.08 * (high - low))  # room for the words of the mark
    last = max(float(panda.time_s[-1]), float(t[-1]))
    if logarithmic(panda):
        log_time(ax, FIRST_S, last)
    else:
        ax.set_xlim(0.0, last)
    mark(ax, panda.theta_start_s, "θ starts")
    time_axis(drawing)
