"""Panels of the body schema's errors (paper, Fig. 4f), and of how they fall."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from adapter.experiment.results import AtlasResults
from adapter.outcome import frame_errors
from adapter.report.experiment_panels import PERCENT, SMALLEST, categories
from adapter.report.experiment_tree import STRETCH
from adapter.report.experiment_words import grouped
from adapter.report.style import (
    ACCENT,
    GOAL,
    MUTED,
    SIZES,
    Drawing,
    Panel,
    joint_color,
    log_axis,
    mark,
    power_of_ten,
    thin,
    time_axis,
)
from adapter.spatial import Array

KINEMATIC_GOAL = 1e-6  # of |k - k_hat| in SI units; ours, the paper states none
KINDS = {
    "v": ("velocity", "m/s"),
    "w": ("angular velocity", "rad/s"),
    "a": ("acceleration", "m/s²"),
    "dw": ("angular acceleration", "rad/s²"),
}


def histogram_panels(atlas: AtlasResults) -> tuple[Panel | None, Panel | None]:
    """Kinematic errors of the networks' λ (Fig. 4f) and of the moments'; None without any.

    Raises:
        ValueError: counts that do not fit the edges.
    """
    error = "errors |k − k̂|"
    samples = atlas.numbers.get("learned_samples")
    on = "the samples" if samples is None else f"the {grouped(samples)} samples"
    return (
        _histogram(
            atlas.error_edges,
            atlas.error_counts,
            f"(f) Kinematic {error}",
            f"λ of (d), from mini-batches, on {on} it learned from",
        ),
        _histogram(
            atlas.error_edges,
            atlas.moments_error_counts,
            f"λ from moments: {error}",
            "on the same samples; θ and Fig. 5d take this λ",
        ),
    )


def _histogram(
    log_edges: Array, by_kind: Mapping[str, Array], title: str, note: str
) -> Panel | None:
    """How large the kinematic errors are, by kind."""
    edges = np.asarray(log_edges, dtype=float)
    counts = {kind: np.asarray(c, dtype=float) for kind, c in by_kind.items()}
    for kind, values in counts.items():
        if len(values) != len(edges) - 1:
            raise ValueError(f"{len(edges)} edges need {len(edges) - 1} counts of '{kind}'")
    counts = {kind: values for kind, values in counts.items() if values.sum() > 0.0}
    if not counts:
        return None
    drawing = Drawing("third", stretch=STRETCH)
    ax = drawing.axes[0]
    for k, (kind, values) in enumerate(counts.items()):
        name, unit = KINDS.get(kind, (kind, ""))
        share = PERCENT * values / values.sum()
        label, color = f"{name} {kind}, {unit}".rstrip(", "), joint_color(k)
        ax.stairs(share, 10.0**edges, color=color, fill=True, alpha=0.18)
        ax.stairs(share, 10.0**edges, color=color, linewidth=1.2, label=label)
    _magnitudes(ax, edges, sum(counts.values(), np.zeros(len(edges) - 1)))
    ax.set_ylim(0.0, 1.5 * ax.dataLim.y1)  # room for the legend, which the goal must not cross
    low, high = np.log10(ax.get_xlim())
    missed = np.log10(KINEMATIC_GOAL) < 0.5 * (low + high)
    ax.legend(
        frameon=False,
        labelcolor=MUTED,
        fontsize=SIZES["third"][2],
        loc="upper right" if missed else "upper left",
        ncols=1,
        handlelength=1.2,
        borderaxespad=0.1,
    )
    mark(ax, KINEMATIC_GOAL, "goal", top=0.6)
    time_axis(drawing, "size of the error, in the unit of its kind")
    most = int(max(values.sum() for values in counts.values()))
    return drawing.panel(title, "% of their kind", f"{note}; {grouped(most)} numbers of a kind")


def _magnitudes(ax: Axes, edges: Array, counts: Array) -> None:
    """A logarithmic x axis around what is counted, with the goal in it."""
    used = np.flatnonzero(counts)
    low, high = edges[used[0]], edges[used[-1] + 1]
    ax.set_xscale("log")
    first, last = 10.0 ** (low - 0.5), 10.0 ** (high + 0.5)
    ax.set_xlim(min(first, 0.25 * KINEMATIC_GOAL), max(last, 4.0 * KINEMATIC_GOAL))
    ax.xaxis.set_major_locator(LogLocator(10, numticks=7))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: power_of_ten(value)))


def schema_panels(atlas: AtlasResults) -> list[Panel]:
    """λ's cost while it is learned, and its error at the epochs of the pictures."""
    panels = []
    cost = np.asarray(atlas.cost, dtype=float)
    good = np.isfinite(cost) & (cost > 0.0)
    if good.sum() > 1:
        drawing = Drawing("third", stretch=STRETCH)
        ax = drawing.axes[0]
        ax.plot(*thin(np.flatnonzero(good).astype(float), cost[good]), color=ACCENT, linewidth=1.2)
        log_axis(ax, 0.3 * cost[good].min(), 3.0 * cost[good].max())
        ax.set_xlim(0.0, 1.04 * len(cost))
        time_axis(drawing, "step of the optimiser")
        panels.append(drawing.panel("Cost of λ, eq. 18", "m²/s² + rad²/s²", "mean over the joints"))
    if atlas.snapshots:
        panels.append(_epoch_errors(atlas))
    return panels


def _epoch_errors(atlas: AtlasResults) -> Panel:
    """One dot per joint: how far its frame is from the actual one in its parent's."""
    n = atlas.tree.n
    lam = np.stack([lam for _, lam in atlas.snapshots])
    every = np.tile(np.eye(6), (n, 1, 1))
    kinds = zip(("turn, rad", "shift, m"), frame_errors(lam, atlas.true_lam, every), strict=True)
    drawing = Drawing("third", stretch=STRETCH)
    ax = drawing.axes[0]
    at = np.arange(len(lam))[:, None] + np.linspace(-0.13, 0.13, n)
    shown = []
    for k, (name, errors) in enumerate(kinds):
        errors = np.maximum(errors, SMALLEST)
        shown.append(errors)
        side, color = -0.18 + 0.36 * k, (ACCENT, GOAL)[k]
        ax.plot(
            (at + side).ravel(),
            errors.ravel(),
            linestyle="none",
            marker="o",
            markersize=2.6,
            color=color,
            alpha=0.75,
            label=name,
        )
    low, high = np.min(shown), np.max(shown)
    log_axis(ax, 0.3 * low, 5.0 * high)
    categories(ax, [label for label, _ in atlas.snapshots])
    ax.legend(frameon=False, labelcolor=MUTED, fontsize=SIZES["third"][2], loc="best")
    return drawing.panel("Error of λ in the pictures", "rad, m", "one dot per joint")
