"""Panels of the gap: errors before and after, and what the residual follows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adapter.effects.catalogue import KNOWN
from adapter.effects.law import OverSignals
from adapter.gap.result import Finding, GapResult, RolloutCurves
from adapter.gap.words import signal_words
from adapter.model.numbers import plain
from adapter.model.spatial import Array
from adapter.report.style import (
    ACCENT,
    GOAL,
    GRID,
    INK,
    MUTED,
    SIZES,
    Drawing,
    Panel,
    categories,
    log_ticks,
    named,
    power_of_ten,
    thin,
    time_axis,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


MOST_JOINTS = 3  # with signatures
BINS, FEWEST_IN_BIN = 24, 4
WIDEST = 99.5  # percentile of |residual| that a panel still holds
SHOWN_ROLLOUT_S = 10.0
LEFT = 0.17  # of a small panel, where "−0.050" must fit
SIGNATURES = (
    ("dq", "Against velocity", "velocity, rad/s"),
    ("q", "Against position", "position, rad"),
    ("tau", "Against load", "measured torque, N m"),
    ("ddq", "Against acceleration", "acceleration, rad/s²"),
)
UNITS = {"q": "rad", "dq": "rad/s", "ddq": "rad/s²", "tau": "N m", "t": "s"}


def error_panels(result: GapResult) -> list[Panel]:
    """Torque and rollout error of every joint, before and after."""
    before, after = result.before, result.after
    panels = []
    if _any(before.torque_rmse_nm):
        errors = before.torque_rmse_nm, after.torque_rmse_nm, result.noise_floor_nm
        drawing, unit = fall_drawing(*errors, result.joint_names), result.unit("N m rms")
        panels.append(drawing.panel("Torque error by joint", unit, "inverse dynamics"))
    if before.rollout_rmse_rad is not None and _any(before.rollout_rmse_rad):
        rollout = after.rollout_rmse_rad
        end = np.full(len(before.rollout_rmse_rad), np.nan) if rollout is None else rollout
        drawing = fall_drawing(1e3 * before.rollout_rmse_rad, 1e3 * end, None, result.joint_names)
        by = f" by {result.simulator}" if result.simulator else ""
        note = f"forward simulation{by}, restarted from the data every 0.5 s"
        panels.append(drawing.panel("Position error by joint", result.unit("mrad rms"), note))
    return panels


def _any(values: Array) -> bool:
    return bool((np.isfinite(values) & (np.asarray(values) > 0.0)).any())


def fall_drawing(before: Array, after: Array, noise: Array | None, names: Sequence[str]) -> Drawing:
    """A line per joint from its error before to that after, on a logarithmic scale."""
    from matplotlib.ticker import FixedLocator

    drawing = Drawing("half")
    ax = drawing.axes[0]
    ax.set_yscale("log")
    for j, (first, last) in enumerate(zip(before, after, strict=True)):
        if noise is not None and noise[j] > 0.0:
            level = [j - 0.3, j + 0.3], [noise[j]] * 2
            ax.plot(*level, color=MUTED, linewidth=1.4, gid=named("noise"))
        if not (np.isfinite(first) and first > 0.0):
            continue
        name = names[j]
        ax.plot([j], [first], "o", color=GOAL, markersize=5, gid=named(f"{name}, before"))
        if np.isfinite(last) and last > 0.0:
            ax.plot([j, j], [first, last], color=GRID, linewidth=2.5, zorder=1)
            ax.plot([j], [last], "o", color=ACCENT, markersize=5, gid=named(f"{name}, after"))
    # limits that hold everything, and ticks at 1, 2 and 5 times powers of ten
    tables = [before, after] if noise is None else [before, after, noise]
    values = np.concatenate([np.asarray(x, dtype=float) for x in tables])
    values = values[np.isfinite(values) & (values > 0.0)]
    low, high = values.min() / 1.5, values.max() * 1.5
    powers = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    wide = len(powers) > 4
    ticks = [s * 10.0**p for p in powers for s in ((1.0,) if wide else (1.0, 2.0, 5.0))]
    ax.set_ylim(low, high)
    log_ticks(ax.yaxis, FixedLocator([t for t in ticks if low <= t <= high]), power_of_ten)
    categories(ax, [str(j + 1) for j in range(len(before))])
    drawing.named_x = True
    time_axis(drawing, "joint")
    return drawing


def shown_joints(result: GapResult) -> list[int]:
    """Joints (from 0) whose signatures are worth a look, the worst ones first.

    Those with something unexplained, then those that findings are about, by what they gain; with
    neither, the one with the largest error.
    """
    if not result.curves:
        return []
    n = len(result.joint_names)
    before = np.nan_to_num(np.asarray(result.before.torque_rmse_nm, dtype=float))
    weight = before / np.maximum(np.nan_to_num(result.noise_floor_nm), 1e-9)
    left = {item.joint - 1 for item in result.unexplained}
    found: set[int] = set()
    for finding in result.findings:
        worth = np.asarray(finding.torque_rms_nm, dtype=float)
        joints = {j - 1 for j in finding.joints}
        found |= joints if joints or not worth.size else {int(np.argmax(np.nan_to_num(worth)))}
    ranked = sorted(range(n), key=lambda j: -weight[j])
    chosen = [j for j in ranked if j in left] + [j for j in ranked if j in found - left]
    return chosen[:MOST_JOINTS] or ranked[:1]


@dataclass(frozen=True)
class JointPanels:
    """Panels of one joint: clouds of its residual, and its residual and motion over time."""

    title: str
    why: str
    clouds: Sequence[Panel]
    times: Sequence[Panel]


def signature_panels(result: GapResult) -> list[JointPanels]:
    """The residual of the joints worth a look, against what it may depend on."""
    panels = []
    for j in shown_joints(result):
        clouds = []
        for key, title, label in SIGNATURES:
            x = np.concatenate([getattr(c, key)[:, j] for c in result.curves])
            named, _, unit = label.rpartition(", ")
            label = f"{named}, {result.unit(unit, j)}"
            cloud = _clouds(result, j, x, ("before", "after"), label)
            laws = [f for f in result.findings if f.joints == (j + 1,) and _follows_alone(f, key)]
            for finding in laws:
                # A law over its signal, with twice its doubt
                ax = cloud.axes[0]
                assert finding.curve is not None
                x, y, std = (
                    np.asarray(finding.curve[key]) for key in ("at", "torque_nm", "std_nm")
                )
                ax.fill_between(x, y - 2.0 * std, y + 2.0 * std, color=INK, alpha=0.2, linewidth=0)
                ax.plot(x, y, color=INK, linewidth=1.0, linestyle=(0, (4, 2)))
            called = ", ".join(f.title for f in laws)
            clouds.append(cloud.panel(title, result.unit("N m", j), called))
        said = []
        for f in result.findings:
            worst = np.argmax(np.nan_to_num(f.torque_rms_nm)) if np.size(f.torque_rms_nm) else -1
            said += [f.title] if j + 1 in f.joints or worst == j else []
        said += ["something unexplained"] * any(x.joint == j + 1 for x in result.unexplained)
        why = filter(None, (result.joint_names[j], ", ".join(dict.fromkeys(said))))
        times = [_over_time(result, j), _motion(result, j)]
        panels.append(JointPanels(f"Joint {j + 1}", "; ".join(why), clouds, times))
    return panels


def _clouds(
    result: GapResult, j: int, x: Array, sides: Sequence[str], label: str, mean: bool = True
) -> Drawing:
    """Torque left on joint j "before" or "after", a dot a sample, and its running mean over x."""
    colors = [ACCENT if side == "after" else GOAL for side in sides]
    ys = [np.concatenate([getattr(c, side)[:, j] for c in result.curves]) for side in sides]
    drawing = Drawing("quarter")
    drawing.figure.subplots_adjust(left=LEFT)
    ax = drawing.axes[0]
    _limits(ax, x, ys)
    _noise_band(ax, result.noise_floor_nm[j])
    for y, color in zip(ys, colors, strict=True):
        _dots(ax, x, y, color)
    for y, color in zip(ys, colors, strict=True) if mean else ():
        ax.plot(*_running_mean(x, y), color=color, linewidth=1.6)
    time_axis(drawing, label)
    return drawing


def _follows_alone(finding: Finding, key: str) -> bool:
    """Whether it is a law of one signal of its own joint."""
    law = KNOWN.get(finding.effect)
    return isinstance(law, OverSignals) and not law.by and law.variables == {key}


def _limits(ax: Axes, x: Array, ys: Sequence[Array]) -> None:
    known = x[np.isfinite(x)]
    if known.size and np.ptp(known) > 0.0:
        margin = 0.02 * np.ptp(known)
        ax.set_xlim(known.min() - margin, known.max() + margin)
    sizes = np.abs(np.concatenate(ys))
    sizes = sizes[np.isfinite(sizes)]
    if sizes.size and sizes.max() > 0.0:
        widest = 1.1 * float(np.percentile(sizes, WIDEST))
        ax.set_ylim(-widest, widest)


def _noise_band(ax: Axes, noise: float) -> None:
    if np.isfinite(noise):
        ax.axhspan(-noise, noise, color=MUTED, alpha=0.16, linewidth=0)
    ax.axhline(0.0, color=MUTED, linewidth=0.6)


def _dots(ax: Axes, x: Array, y: Array, color: str) -> None:
    """A cloud as one path of round dots: a marker each would make the page ten times as long."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    keep = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not keep.size:
        return
    keep = keep[np.unique(np.linspace(0, len(keep) - 1, 500).astype(int))]  # no more
    points = np.repeat(np.column_stack([x[keep], y[keep]]), 2, axis=0)
    path = Path(points, np.tile([Path.MOVETO, Path.LINETO], len(keep)))
    path.should_simplify = False
    look = {"facecolor": "none", "edgecolor": color, "capstyle": "round"}
    ax.add_patch(PathPatch(path, linewidth=1.8, alpha=0.45, **look))


def _running_mean(x: Array, y: Array) -> tuple[Array, Array]:
    """Mean of y in bins of x with as many points each."""
    known = np.isfinite(x) & np.isfinite(y)
    order = np.flatnonzero(known)[np.argsort(x[known])]
    parts = np.array_split(order, max(1, min(BINS, len(order) // FEWEST_IN_BIN)))
    parts = [part for part in parts if len(part)]
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts])


def _over_time(result: GapResult, j: int) -> Panel:
    """Of the first recording, where findings count their time."""
    curves = result.curves[0]
    drawing = Drawing("half")
    ax = drawing.axes[0]
    _limits(ax, curves.t, [curves.before[:, j], curves.after[:, j]])
    _noise_band(ax, result.noise_floor_nm[j])
    for finding in result.findings:  # where those begin and end that come or go meanwhile
        begin, end = finding.interval_s
        for edge in ([begin] if begin > 0.0 else []) + ([] if finding.lasting else [end]):
            ax.axvline(edge, color=MUTED, linewidth=0.9, linestyle=(0, (4, 2)))
    ax.plot(*_line(curves.t, curves.before[:, j]), color=GOAL, linewidth=0.9)
    ax.plot(*_line(curves.t, curves.after[:, j]), color=ACCENT, linewidth=0.9)
    time_axis(drawing, "time, s")
    return drawing.panel("Over time", result.unit("N m", j), f"of {curves.recording}")


def _line(t: Array, y: Array) -> tuple[Array, Array]:
    """A line over time, thinned, with a break where time is left out."""
    t, y = thin(t, y)
    breaks = np.flatnonzero(np.diff(t) > 1.0) + 1  # s
    return np.insert(t, breaks, t[breaks]), np.insert(y, breaks, np.nan)


def _motion(result: GapResult, j: int) -> Panel:
    """Forward simulation of a joint against data; its torque where nothing was simulated."""
    rollout = next((r for r in result.rollouts if np.isfinite(r.before[:, j]).any()), None)
    if rollout is not None:
        start, stop = worst_window(rollout.t, rollout.before[:, j] - rollout.measured[:, j])
        note = "position, restarted from the data every 0.5 s; below, how far it is off"
        return rollout_drawing(rollout, j, start, stop).panel("Forward simulation", "rad", note)
    curves = result.curves[0]
    drawing = Drawing("half")
    ax, tau = drawing.axes[0], curves.tau[:, j]
    ax.plot(*_line(curves.t, tau), color=INK, linewidth=2.2, alpha=0.3)
    for left, color in ((curves.before, GOAL), (curves.after, ACCENT)):
        ax.plot(*_line(curves.t, tau - left[:, j]), color=color, linewidth=0.9)
    time_axis(drawing, "time, s")
    unit, note = result.unit("N m", j), f"of {curves.recording}"
    return drawing.panel("Torque, measured and predicted", unit, note)


def rollout_drawing(rollout: RolloutCurves, j: int, start: float, stop: float) -> Drawing:
    """Motion of a joint, measured and simulated, from a time to another, and how far it is off."""
    drawing = Drawing("half", rows=(1.5, 1.0), stretch=1.0)
    above, below = drawing.axes
    keep = (rollout.t >= start) & (rollout.t <= stop)
    t, measured = rollout.t[keep], rollout.measured[keep, j]
    above.plot(*thin(t, measured), color=INK, linewidth=2.6, alpha=0.3)
    worst = 0.0
    for simulated, color in ((rollout.before, GOAL), (rollout.after, ACCENT)):
        path = simulated[keep, j]
        above.plot(*thin(t, path), color=color, linewidth=1.0)
        below.plot(*thin(t, 1e3 * (path - measured)), color=color, linewidth=0.9)
        error = 1e3 * np.abs(path - measured)
        worst = max(worst, float(np.nanmax(error)) if np.isfinite(error).any() else 0.0)
    below.axhline(0.0, color=MUTED, linewidth=0.6)
    if worst > 0.0:
        below.set_ylim(-1.1 * worst, 1.1 * worst)
    below.set_ylabel("mrad off")  # for the pointer; drawn inside, where long numbers leave room
    below.yaxis.label.set_visible(False)
    axes, size = below.transAxes, SIZES["half"][2]
    below.text(0.01, 0.95, "mrad off", transform=axes, color=MUTED, fontsize=size, va="top")
    below.set_xlim(start, stop)
    time_axis(drawing, "time, s")
    return drawing


def worst_window(t: Array, left: Array) -> tuple[float, float]:
    """The stretch of at most 10 s in which most is left of a joint's motion."""
    if t[-1] - t[0] <= SHOWN_ROLLOUT_S:
        return float(t[0]), float(t[-1])
    error = np.nan_to_num(left) ** 2
    starts = np.arange(t[0], t[-1] - SHOWN_ROLLOUT_S + 1e-9, 0.5)
    sums = [error[(t >= s) & (t <= s + SHOWN_ROLLOUT_S)].sum() for s in starts]
    start = float(starts[int(np.argmax(sums))])
    return start, start + SHOWN_ROLLOUT_S


def unexplained_panels(result: GapResult) -> list[Panel]:
    """What is left against the signal that it follows most, one panel each."""
    panels = []
    for item in result.unexplained if result.curves else ():
        name = item.depends_on[0] if item.depends_on else "t"
        x = _signal(result, name)
        if x is None:
            name, x = "t", np.concatenate([c.t for c in result.curves])
        label = f"{signal_words(name)}, {UNITS[re.sub(r'[0-9]+$', '', name)]}"
        drawing = _clouds(result, item.joint - 1, x, ("after",), label, mean=name != "t")
        unit = result.unit("N m", item.joint - 1)
        note = f"{plain(item.rmse_nm, 2)} {unit} rms, noise {plain(item.noise_floor_nm, 2)} {unit}"
        panels.append(drawing.panel(f"Left on joint {item.joint}", unit, note))
    return panels


def _signal(result: GapResult, name: str) -> Array | None:
    """A signal by its name in findings ("dq3", "t") over all recordings; None for another name."""
    if name == "t":
        return np.concatenate([c.t for c in result.curves])
    found = re.fullmatch(r"(q|dq|ddq|tau)(\d+)", name)
    if found is None or not 1 <= int(found[2]) <= len(result.joint_names):
        return None
    return np.concatenate([getattr(c, found[1])[:, int(found[2]) - 1] for c in result.curves])
