"""One self-contained page out of a run's data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapter.gap.monitor_judge import sentence
from adapter.model.self_model import LAMBDA_MEASURED
from adapter.report import tables, words
from adapter.report.html import fill, write_whole
from adapter.report.schema_panels import schema_panels
from adapter.report.skeleton import has_reference, skeleton_panels
from adapter.report.style import JOINT_COLORS
from adapter.report.timing_panels import histogram_panels, tracking_panel, tracking_table
from adapter.report.torque_panels import (
    change_times,
    effect_panels,
    fit_panels,
    fit_window,
    prequential_panels,
    theta_panels,
    theta_started,
)
from adapter.runs.run_folder import RunData
from adapter.runs.score import TORQUE_GOAL, counted_from

TEMPLATE = "report.html"
MOST_TILES = 5  # side by side


@dataclass(frozen=True)
class Tile:
    """A key figure: its name, its value, and what to hold it against."""

    name: str
    value: str
    note: str = ""


def render(data: RunData) -> str:
    """The page as HTML text; parts that the run does not have are left out."""
    return fill(TEMPLATE, context(data))


def write_report(path: str | Path, data: RunData) -> Path:
    """Write the page, whole or not at all. Returns the path.

    Raises:
        RunFolderError: the file cannot be written.
    """
    return write_whole(path, render(data))


def context(data: RunData) -> dict[str, Any]:
    """What the template shows."""
    figures, started, shown = data.figures, theta_started(data), tiles(data)
    return {
        "robot": data.documented.name,
        "headline": words.headline(figures),
        "source": figures["lambda"].get("source") or data.model.lambda_source,
        "measured": data.model.lambda_source == LAMBDA_MEASURED,
        "against": "" if data.reference is None else words.against(figures),
        "live": words.is_live(figures),
        "tiles": shown,
        "columns": len(shown) if len(shown) <= MOST_TILES else (len(shown) + 1) // 2,
        "joints": [
            (j % JOINT_COLORS + 1, name) for j, name in enumerate(data.documented.tree.joint_names)
        ],
        "schema": schema_panels(data),
        "skeleton": skeleton_panels(data),
        "has_reference": has_reference(data),
        "started": started,
        "torque_goal": f"{TORQUE_GOAL:g}",
        "theta": theta_panels(data) if started else [],
        "effects": effect_panels(data) if started else [],
        "prequential": prequential_panels(data) if started else [],
        "fit": fit_panels(data) if started else [],
        "fit_span": _fit_span(data) if started else "",
        "joint_table": tables.joint_table(data),
        "matrices": [tables.schema_matrix(data), tables.theta_matrix(data)],
        "changes": tables.changes_table(data),
        "refused": tables.refused_table(figures),
        "gaps": len(figures.get("gaps") or []),
        "warnings": _warnings(figures),
        "granted": [str(line) for line in figures.get("granted") or []],
        "speed": words.number(figures.get("times_real_time")),
        "timing": tables.timing_table(figures),
        "missed": figures.get("missed_deadlines"),
        "histograms": histogram_panels(figures),
        "tracking": tracking_table(figures),
        "tracking_panel": tracking_panel(figures),
        "theta_table": tables.theta_table(data),
        "schema_table": tables.schema_table(data),
        "provenance": tables.provenance_rows(data),
    }


def _warnings(figures: dict[str, Any]) -> list[str]:
    fault = figures.get("fault")
    ended = [f"The run ended early: {fault}"] if fault else []
    start_s = figures.get("start_s") or 0.0
    reports = figures.get("disagreements") or []
    new = [f"New disagreement: {sentence(report, start_s)}" for report in reports]
    return [*ended, *new, *map(str, figures.get("warnings") or [])]


def _fit_span(data: RunData) -> str:
    t = data.times(data.score_trace)[fit_window(data)]
    return f"{words.number(t[0])} to {words.quantity(t[-1], 's')}" if len(t) else ""


def tiles(data: RunData) -> list[Tile]:
    """Key figures, those that the run has."""
    figures = data.figures
    found = [*_schema_tiles(data), *_theta_tiles(data)]
    learned = f"{words.count(figures['learned'])}"
    found.append(Tile("Samples learned", learned, f"of {words.count(figures['samples'])} read"))
    tick = figures.get("tick_us") or {}
    if tick.get("p50") is not None:
        note = f"{'driver, ' if words.is_live(figures) else ''}filter and synthesis, median"
        if tick.get("p99") is not None:
            note += f"; p99 {words.quantity(tick['p99'], 'µs')}"
        found.append(Tile("Compute per sample", words.quantity(tick["p50"], "µs"), note))
    if words.is_live(figures):
        missed = words.count(figures.get("missed_deadlines") or 0)
        found.append(
            Tile("Deadlines missed", missed, f"in {words.count(figures['samples'])} ticks")
        )
    return found


def _schema_tiles(data: RunData) -> list[Tile]:
    schema = data.figures["lambda"]
    at = schema.get("converged_s")
    value = "not reached" if at is None else words.quantity(at, "s", 3)
    note = f"after {counted_from(data.figures)}, to stay within {words.GOALS}"
    if schema.get("restarts"):
        note += f"; joints started anew {schema['restarts']} times, out of wrong valleys"
    found = [Tile("λ converged", value, note)]
    turn, shift = schema.get("rotation_error_rad"), schema.get("position_error_m")
    if turn and shift and None not in [*turn, *shift]:
        note = (
            f"and {words.small(1e3 * max(shift), 'mm')}, largest of any joint, in what motion shows"
        )
        found.append(Tile("λ error", words.small(1e3 * max(turn), "mrad"), note))
    return found


def _theta_tiles(data: RunData) -> list[Tile]:
    theta = data.figures["theta"]
    if not theta_started(data):
        return [Tile("θ", "not learned", "λ had not converged")]
    at = theta.get("converged_s")
    value = "not reached" if at is None else words.quantity(at, "s", 3)
    goal = f"{TORQUE_GOAL:g} × batch least squares"
    note = f"after {counted_from(data.figures)}, to stay within {goal}"
    found = [Tile("θ converged", value, note)]
    if theta.get("torque_rmse_nm"):
        text = words.spread(theta["torque_rmse_nm"], "N m")
        found.append(Tile("Torque not explained", text, "rms, best to worst joint"))
    if theta.get("validation_torque_rmse_nm"):
        text = words.spread(theta["validation_torque_rmse_nm"], "N m")
        found.append(Tile("On data held out", text, "rms, best to worst joint"))
    if change_times(data):
        load = (theta["changes"][-1].get("payload") or {}).get("m")
        at_s = words.quantity(change_times(data)[-1], "s")
        if load is not None:
            found.append(Tile("Load noticed", words.quantity(load, "kg"), f"{at_s} into the run"))
    return found
