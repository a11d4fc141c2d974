"""Panels of timing and of how well the arm followed its commands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from adapter.report.style import ACCENT, MUTED, SIZES, Drawing, Panel
from adapter.report.tables import TIMES, Table
from adapter.report.words import count, number

TRACKED = {
    "feedback": "feedback alone",
    "feedforward": "with feed-forward",
    "documented": "feed-forward of the documented model",
    "learned": "feed-forward of the learned model",
}


def histogram_panels(figures: Mapping[str, Any]) -> list[Panel]:
    """Histograms, where the run kept them: counts over durations in µs."""
    given = (figures.get("timing") or {}).get("histograms") or figures.get("histograms") or {}
    panels = []
    for key, bins in given.items():
        edges, counts = np.array(bins["edges_us"], float), np.array(bins["counts"], float)
        if not counts.any():
            continue
        drawing = Drawing("half")
        ax = drawing.axes[0]
        ax.stairs(counts, edges, color=ACCENT, fill=True, alpha=0.75)
        if counts.max() > 100:
            ax.set_yscale("symlog", linthresh=1.0)
            ax.set_ylim(0.0, 2.0 * counts.max())
        text = SIZES["half"][2]
        ax.set_xlabel("duration, µs", color=MUTED, labelpad=1.5, fontsize=text)
        name = TIMES.get(key, key.removesuffix("_us").replace("_", " ").capitalize())
        panels.append(drawing.panel(name, "ticks per bin"))
    return panels


def tracking_table(figures: Mapping[str, Any]) -> Table | None:
    """Tracking error by way of control; None where nothing was tracked."""
    names, rows = dict(TRACKED), []
    if figures.get("feedforward"):
        names["feedforward"] = f"with feed-forward of the {figures['feedforward']} model"
    for name, values in (figures.get("tracking") or {}).items():
        if not (isinstance(values, Mapping) and values.get("rms_rad")):
            continue
        rms = 1e3 * np.array(values["rms_rad"], float)
        most = values.get("max_rad")
        rows.append(
            [
                names.get(name, name.replace("_", " ")),
                count(values.get("samples") or 0),
                number(float(np.sqrt(np.mean(rms**2)))),
                number(None if not most else 1e3 * max(most)),
            ]
        )
    heads = ["Control", "Samples", "rms, all joints", "largest"]
    return Table(heads, rows, ["", "", "mrad", "mrad"]) if rows else None
