"""Panels over time: the body schema λ, θ and its effects, torque errors, and the fit by joint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from adapter.effects import effects_by_name
from adapter.effects.base import with_squares
from adapter.gap.phrases import SHOWN_UNITS
from adapter.model.inertia import PARAMETERS
from adapter.model.spatial import Array, log_rotation, matrix_from_zxz
from adapter.physics.identifiability import SHOWN_ALONE
from adapter.report.style import (
    ACCENT,
    GOAL,
    INK,
    MUTED,
    SIZES,
    Drawing,
    Panel,
    joint_color,
    level,
    lines_by_joint,
    log_axis,
    log_time,
    mark,
    named,
    thin,
    thin_rows,
    time_axis,
)
from adapter.runs.run_folder import RunData
from adapter.runs.score import (
    POSITION_GOAL_M,
    ROTATION_GOAL_RAD,
    TORQUE_GOAL,
    TORQUE_WINDOW_S,
    trailing_rms,
)

FIRST_S = 0.05  # left end of a logarithmic time axis
LOWEST = 1e-5  # rad, m; of an error that is shown; below it a line leaves the panel
SETTLED = "inside both goals"
SHOWN_ERROR = 2.0  # times what it comes down to; what is higher leaves the panel
FIRST_SHOWN_S = 0.2  # of the running mean; before it there is next to nothing in it
GROUPS = (("kg", (0,)), ("kg m", (1, 2, 3)), ("kg m²", (4, 7, 9, 5, 6, 8)))  # of ten parameters
COLOR_OF = (7, 0, 1, 2, 0, 3, 4, 1, 5, 2)  # of each parameter, as of a joint of that number
BODY_PARTS = ((8, "m"), *enumerate(("mX, XX", "mY, YY", "mZ, ZZ", "XY", "XZ", "YZ"), start=1))
MOST_ROWS = 160  # along a line of a small panel


def schema_panels(data: RunData) -> list[Panel]:
    """λ over time (the paper's Fig. 6a), and its errors where there is a reference."""
    t = data.times(data.schema_trace)
    lam = data.schema_trace[:, 1:].reshape(-1, data.n, 6)
    if len(t) < 2:
        return []
    converged = data.converged_s("lambda")
    # most happens at first: values are shown up to here, errors to the end
    until = t[-1] if converged is None else min(t[-1], max(3.0, 2.5 * converged))
    early, values = thin_rows(t[t <= until], lam[t <= until])
    shown = "" if until == t[-1] else f"; the first {until:.2g} of {t[-1]:.3g} s"
    note = f"in its parent's, x solid, y dashed, z dotted{shown}"
    turns, shifts = rotation_path(values), values[..., 3:]
    panels = []
    for what, unit, told, path in (
        ("Orientation", "rad", "rotation vector", turns),
        ("Position", "m", "origin", shifts),
    ):
        drawing, told = _components(early, path, converged), f"{told} of each frame {note}"
        panels.append(drawing.panel(f"{what} of the joint frames", unit, told))
    if data.reference is None:
        return panels
    goals = (ROTATION_GOAL_RAD, "rad"), (POSITION_GOAL_M, "m")
    titles = "Orientation error", "Position error"
    for title, error, (goal, unit) in zip(titles, data.schema_errors, goals, strict=True):
        drawing = Drawing("half")
        ax = drawing.axes[0]
        top = max(float(error.max()), 10 * goal)
        right = t >= FIRST_S
        lines_by_joint(ax, t[right], np.maximum(error[right], 1e-3 * LOWEST))
        log_axis(ax, LOWEST, 2 * top)
        log_time(ax, FIRST_S, t[-1])
        late = converged is None or converged > 0.2 * t[-1]  # then lines cross the right end
        level(ax, goal, f"goal {goal:g} {unit}", left=late)
        mark(ax, converged, SETTLED)
        time_axis(drawing)
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
        for axis, dashes in enumerate([(0, ()), (0, (4, 1.5)), (0, (1, 1.3))]):  # x, y, z
            name = named(f"joint {j + 1} {'xyz'[axis]}")
            (line,) = ax.plot(t, values[:, j, axis], gid=name, color=joint_color(j), linewidth=1.0)
            line.set_linestyle(dashes)
    ax.set_xlim(min(0.0, t[0]), t[-1])
    ax.margins(y=0.12)  # room for the words of the mark
    mark(ax, converged, SETTLED)
    time_axis(drawing)
    return drawing


def change_times(data: RunData) -> list[float]:
    """Times of the changes at the hand, s after the first motion."""
    changes = data.figures["theta"].get("changes") or []
    return [change["stamp_s"] - data.start_s for change in changes]


def refusal(figures: Mapping[str, Any]) -> str | None:
    """Why the torques of a live run are not its arm's, a sentence; None where nobody says so."""
    return (figures.get("torques") or {}).get("refusal")


def theta_started(data: RunData) -> bool:
    """Whether θ was learned at all, and from this arm's torques."""
    return refusal(data.figures) is None and len(data.theta_trace) > 0 and len(data.score_trace) > 0


def bodies_over_time(data: RunData, rows: Array) -> Array:
    """θ (k, n, 10) in use; the spare body stands for the last link from the first change on."""
    n = data.n
    bodies = rows[:, 1 : 1 + 10 * (n + 1)].reshape(len(rows), n + 1, 10)
    theta = bodies[:, :n].copy()
    for first in change_times(data)[:1]:
        after = data.times(rows) >= first
        theta[after, -1] = bodies[after, n]
    return theta


def body_panels(data: RunData) -> list[Panel]:
    """θ over time (the paper's Fig. 6b), a panel per link: mass, first moments, inertia."""
    from matplotlib.ticker import MaxNLocator

    t, rows = thin_rows(data.times(data.theta_trace), data.theta_trace, MOST_ROWS)
    theta = bodies_over_time(data, rows)
    panels = []
    for j, link in enumerate(data.documented.tree.link_names):
        drawing = Drawing("quarter", rows=(0.7, 1.0, 1.3), stretch=1.7)
        for ax, (unit, parts) in zip(drawing.axes, GROUPS, strict=True):
            for k in parts:
                alone = data.theta_shown[j, k] > SHOWN_ALONE
                width, alpha = (1.3, 1.0) if alone else (0.7, 0.6)
                name = named(PARAMETERS[k] if alone else f"({PARAMETERS[k]})")
                color = joint_color(COLOR_OF[k])
                ax.plot(t, theta[:, j, k], color=color, linewidth=width, alpha=alpha, gid=name)
            ax.set_ylabel(unit, color=MUTED, fontsize=SIZES["quarter"][2], labelpad=1.0)
            ax.yaxis.set_major_locator(MaxNLocator(3))
        drawing.figure.subplots_adjust(left=0.21, hspace=0.1)
        drawing.figure.align_ylabels()
        _finish(drawing, t, data)
        panels.append(drawing.panel(link, ""))
    return panels


def effect_panels(data: RunData) -> list[Panel]:
    """Friction and the other effects over time, one panel each."""
    names = list(data.figures["theta"].get("effects") or {})
    t, rows = thin_rows(data.times(data.theta_trace), data.theta_trace)
    values = rows[:, 1 + 10 * (data.n + 1) :].reshape(len(rows), -1, data.n)
    panels = []
    for k, effect in enumerate(effects_by_name(names)):
        drawing = Drawing("quarter")
        factor, unit = SHOWN_UNITS.get(effect.unit, (1.0, with_squares(effect.unit)))
        lines_by_joint(drawing.axes[0], t, factor * values[:, k])
        _finish(drawing, t, data)
        title = effect.name.replace("_", " ").capitalize()
        panels.append(drawing.panel(f"{title} {effect.key}", unit))
    return panels


def _finish(drawing: Drawing, t: Array, data: RunData) -> None:
    drawing.axes[0].set_xlim(min(0.0, t[0]), t[-1])
    for at in change_times(data):
        for ax in drawing.axes:
            mark(ax, at, "change" if ax is drawing.axes[0] else "")
    time_axis(drawing)


def error_panel(data: RunData) -> Panel:
    """Torque error of each sample before it was learned from, against batch least squares.

    In units of each joint's noise, as convergence is judged; up to the first change.
    """
    t = data.times(data.score_trace)
    _, _, _, tau, error = data.score_signals()
    changes = change_times(data)
    early = t < changes[0] if changes else np.ones(len(t), dtype=bool)
    scale = np.maximum(data.noise, 1e-12) * np.sqrt(data.n)
    ours = trailing_rms(t, error / scale, TORQUE_WINDOW_S)
    batch = trailing_rms(t[early], (tau - data.batch)[early] / scale, TORQUE_WINDOW_S)
    drawing = Drawing("half")
    ax = drawing.axes[0]
    shown, inside = t > t[0] + FIRST_SHOWN_S, t[early] > t[0] + FIRST_SHOWN_S
    ax.plot(*thin(t[early][inside], batch[inside]), color=MUTED, linewidth=1.1, gid=named("batch"))
    goal = thin(t[early][inside], TORQUE_GOAL * batch[inside])
    ax.plot(*goal, color=GOAL, linewidth=1.0, linestyle=(0, (4, 2)), gid=named("goal"))
    ax.plot(*thin(t[shown], ours[shown]), color=ACCENT, linewidth=1.5, gid=named("learned online"))
    if inside.any():
        usual = float(np.median(ours[t >= 0.5 * (t[0] + t[-1])]))
        ax.set_ylim(0.0, max(SHOWN_ERROR * TORQUE_GOAL * float(batch[inside].max()), 1.5 * usual))
    _finish(drawing, t, data)
    mark(ax, data.converged_s("theta"), f"inside {TORQUE_GOAL:g} × batch", top=0.88)
    note = f"rms over {TORQUE_WINDOW_S:g} s and all joints; each sample is predicted first, then "
    note += "learned from"
    return drawing.panel("Prequential torque error", "in units of the noise", note)


def error_by_joint(data: RunData) -> Panel:
    """The same of each joint, in N m."""
    t = data.times(data.score_trace)
    error = data.score_signals()[4]
    drawing = Drawing("half")
    ax = drawing.axes[0]
    shown = t > t[0] + FIRST_SHOWN_S
    rms = np.stack([trailing_rms(t, error[:, j : j + 1], TORQUE_WINDOW_S) for j in range(data.n)])
    lines_by_joint(ax, t[shown], rms[:, shown].T)
    late = shown & (t >= 0.5 * (t[0] + t[-1]))
    if late.any():
        ax.set_ylim(0.0, SHOWN_ERROR * float(rms[:, late].max()))
    _finish(drawing, t, data)
    note = f"rms over {TORQUE_WINDOW_S:g} s of the error before learning"
    return drawing.panel("Prequential torque error by joint", "N m", note)


def fit_window(data: RunData) -> Array:
    """Which rows of the score (bool) the fit is shown for: after the last change, the last 20 s."""
    t = data.times(data.score_trace)
    start = max([t[-1] - 20.0, *change_times(data)])
    return np.asarray(t >= start)


def fit_panels(data: RunData) -> list[Panel]:
    """Measured torque, the learned model's, and what is left, one panel per joint."""
    from matplotlib.ticker import MaxNLocator

    rows = fit_window(data)
    t = data.times(data.score_trace)[rows]
    tau, fit = data.score_signals()[3][rows], data.fit[rows]
    if len(t) < 2:
        return []
    panels = []
    for j in range(data.n):
        drawing = Drawing("quarter", rows=(2.3, 1.0), stretch=1.15)
        above, below = drawing.axes
        above.plot(*thin(t, tau[:, j]), color=INK, linewidth=2.2, alpha=0.3, gid=named("measured"))
        above.plot(*thin(t, fit[:, j]), color=joint_color(j), linewidth=1.0, gid=named("model"))
        left = tau[:, j] - fit[:, j]
        below.axhline(0.0, color=MUTED, linewidth=0.6)
        below.plot(*thin(t, left), color=joint_color(j), linewidth=0.7, gid=named("left"))
        widest = max(float(np.abs(left).max()), 1e-6)
        below.set_ylim(-1.15 * widest, 1.15 * widest)
        below.yaxis.set_major_locator(MaxNLocator(3))
        below.set_xlim(t[0], t[-1])
        time_axis(drawing)
        rms = float(np.sqrt(np.mean(left**2)))
        unit = data.documented.tree.unit("N m", "N", j)
        panels.append(drawing.panel(f"Joint {j + 1}", unit, f"residual {rms:.3g} {unit} rms"))
    return panels
