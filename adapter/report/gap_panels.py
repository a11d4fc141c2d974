"""Panels of the gap's size: errors of every joint before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from adapter.gap.result import GapResult
from adapter.model.spatial import Array
from adapter.report.style import (
    ACCENT,
    GOAL,
    GRID,
    MUTED,
    Drawing,
    Panel,
    categories,
    log_ticks,
    named,
    power_of_ten,
    time_axis,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def error_panels(result: GapResult) -> list[Panel]:
    """Torque and rollout error of every joint, before and after."""
    before, after = result.before, result.after
    panels = []
    if _any(before.torque_rmse_nm):
        drawing = fall_drawing(
            before.torque_rmse_nm, after.torque_rmse_nm, result.noise_floor_nm, result.joint_names
        )
        panels.append(drawing.panel("Torque error by joint", "N m rms", "inverse dynamics"))
    if before.rollout_rmse_rad is not None and _any(before.rollout_rmse_rad):
        rollout = after.rollout_rmse_rad
        end = np.full(len(before.rollout_rmse_rad), np.nan) if rollout is None else rollout
        drawing = fall_drawing(1e3 * before.rollout_rmse_rad, 1e3 * end, None, result.joint_names)
        by = f" by {result.simulator}" if result.simulator else ""
        note = f"forward simulation{by}, restarted from the data every 0.5 s"
        panels.append(drawing.panel("Position error by joint", "mrad rms", note))
    return panels


def _any(values: Array) -> bool:
    return bool((np.isfinite(values) & (np.asarray(values) > 0.0)).any())


def fall_drawing(before: Array, after: Array, noise: Array | None, names: Sequence[str]) -> Drawing:
    """A line per joint from its error before to that after, on a logarithmic scale."""
    drawing = Drawing("half")
    ax = drawing.axes[0]
    ax.set_yscale("log")
    for j, (first, last) in enumerate(zip(before, after, strict=True)):
        if noise is not None and noise[j] > 0.0:
            ax.plot(
                [j - 0.3, j + 0.3], [noise[j]] * 2, color=MUTED, linewidth=1.4, gid=named("noise")
            )
        if not (np.isfinite(first) and first > 0.0):
            continue
        name = names[j]
        ax.plot([j], [first], "o", color=GOAL, markersize=5, gid=named(f"{name}, before"))
        if np.isfinite(last) and last > 0.0:
            ax.plot([j, j], [first, last], color=GRID, linewidth=2.5, zorder=1)
            ax.plot([j], [last], "o", color=ACCENT, markersize=5, gid=named(f"{name}, after"))
    _log_scale(ax, [before, after, *([] if noise is None else [noise])])
    categories(ax, [str(j + 1) for j in range(len(before))])
    drawing.named_x = True
    time_axis(drawing, "joint")
    return drawing


def _log_scale(ax: Axes, tables: Sequence[Array]) -> None:
    """Limits that hold everything, and ticks at 1, 2 and 5 times powers of ten."""
    from matplotlib.ticker import FixedLocator

    values = np.concatenate([np.asarray(x, dtype=float) for x in tables])
    values = values[np.isfinite(values) & (values > 0.0)]
    low, high = values.min() / 1.5, values.max() * 1.5
    powers = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    wide = len(powers) > 4
    ticks = [s * 10.0**p for p in powers for s in ((1.0,) if wide else (1.0, 2.0, 5.0))]
    ax.set_ylim(low, high)
    log_ticks(ax.yaxis, FixedLocator([t for t in ticks if low <= t <= high]), power_of_ten)
