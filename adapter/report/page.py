"""One self-contained page out of a run's data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from adapter.gap.monitor_judge import sentence
from adapter.model.self_model import LAMBDA_MEASURED
from adapter.report import learned_panels, tables, words
from adapter.report.html import fill, write_whole
from adapter.report.next_steps import next_steps
from adapter.report.skeleton import has_reference, skeleton_panels
from adapter.report.style import ACCENT, JOINT_COLORS, Drawing, Panel, time_axis
from adapter.report.trust import against, checks, headline
from adapter.report.worth import Worth, truth_tables, worth_panels, worth_table
from adapter.runs.run_folder import RunData
from adapter.runs.score import TORQUE_GOAL

TRACKED = {
    "feedback": "feedback alone",
    "feedforward": "with feed-forward",
    "documented": "feed-forward of the documented model",
    "learned": "feed-forward of the learned model",
}


def render(data: RunData) -> str:
    """The page as HTML text; parts that the run does not have are left out."""
    return fill("report.html", context(data))


def write_report(path: str | Path, data: RunData) -> Path:
    """Write the page, whole or not at all. Returns the path.

    Raises:
        RunFolderError: the file cannot be written.
    """
    return write_whole(path, render(data))


def context(data: RunData) -> dict[str, Any]:
    """What the template shows."""
    figures, started, worth = data.figures, learned_panels.theta_started(data), Worth.of(data)
    fit = data.times(data.score_trace)[learned_panels.fit_window(data)] if started else []
    fault, start_s = figures.get("fault"), figures.get("start_s") or 0.0
    names = data.documented.tree.joint_names
    errors = learned_panels.error_panel, learned_panels.error_by_joint
    ended = [f"The run ended early: {fault}"] if fault else []
    new = [f"New disagreement: {sentence(x, start_s)}" for x in words.not_learned(figures)]
    return {
        "robot": data.documented.name,
        "headline": headline(data, worth),
        "source": figures["lambda"].get("source") or data.model.lambda_source,
        "measured": data.model.lambda_source == LAMBDA_MEASURED,
        "against": "" if data.reference is None else against(figures),
        "live": words.is_live(figures),
        "worth_table": worth_table(data, worth),
        "worth_panels": worth_panels(data, worth),
        "doubt": worth.torque is not None and worth.torque.after_std is not None,
        "checks": checks(data, worth),
        "steps": next_steps(data, worth),
        "joints": [(j % JOINT_COLORS + 1, name) for j, name in enumerate(names)],
        "schema": learned_panels.schema_panels(data),
        "skeleton": skeleton_panels(data),
        "has_reference": has_reference(data),
        "started": started,
        "torque_goal": f"{TORQUE_GOAL:g}",
        "body_parts": learned_panels.BODY_PARTS,
        "bodies": learned_panels.body_panels(data) if started else [],
        "effects": learned_panels.effect_panels(data) if started else [],
        "prequential": [panel(data) for panel in (errors if started else ())],
        "fit": learned_panels.fit_panels(data) if started else [],
        "fit_span": f"{words.number(fit[0])} to {words.quantity(fit[-1], 's')}" if len(fit) else "",
        "joint_tables": tables.joint_tables(data),
        "matrices": [tables.schema_matrix(data), tables.theta_matrix(data)],
        "changes": tables.changes_table(data),
        "truths": truth_tables(data),
        "refused": tables.refused_table(figures),
        "gaps": len(figures.get("gaps") or []),
        "warnings": [*ended, *new, *map(str, figures.get("warnings") or [])],
        "granted": [str(line) for line in figures.get("granted") or []],
        "speed": words.number(figures.get("times_real_time")),
        "timing": tables.timing_table(figures),
        "histograms": _histogram_panels(figures),
        "tracking": _tracking_table(figures),
        "theta_table": tables.theta_table(data),
        "schema_table": tables.schema_table(data),
        "provenance": tables.provenance_rows(data),
    }


def _histogram_panels(figures: Mapping[str, Any]) -> list[Panel]:
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
        time_axis(drawing, "duration, µs")
        panels.append(drawing.panel(tables.named(key), "ticks per bin"))
    return panels


def _tracking_table(figures: Mapping[str, Any]) -> tables.Table | None:
    """Tracking error by way of control; None where nothing was tracked."""
    names, rows = dict(TRACKED), []
    if figures.get("feedforward"):
        names["feedforward"] = f"with feed-forward of the {figures['feedforward']} model"
    for name, values in (figures.get("tracking") or {}).items():
        if not (isinstance(values, Mapping) and values.get("rms_rad")):
            continue
        rms = 1e3 * np.array(values["rms_rad"], float)
        most = values.get("max_rad")
        sizes = float(np.sqrt(np.mean(rms**2))), None if not most else 1e3 * max(most)
        count = words.count(values.get("samples") or 0)
        rows.append([names.get(name, name.replace("_", " ")), count, *map(words.number, sizes)])
    heads = ["Control", "Samples", "rms, all joints", "largest"]
    return tables.Table(heads, rows, ["", "", "mrad", "mrad"]) if rows else None
