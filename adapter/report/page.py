"""One self-contained page out of a run's data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from adapter.gap.monitor_judge import sentence
from adapter.model.self_model import LAMBDA_MEASURED
from adapter.report import tables, words
from adapter.report.headline import against, headline
from adapter.report.html import fill, write_whole
from adapter.report.next_steps import next_steps
from adapter.report.schema_panels import schema_panels
from adapter.report.skeleton import has_reference, skeleton_panels
from adapter.report.style import JOINT_COLORS
from adapter.report.timing_panels import histogram_panels, tracking_table
from adapter.report.torque_panels import (
    BODY_PARTS,
    body_panels,
    effect_panels,
    fit_panels,
    fit_window,
    prequential_panels,
    theta_started,
)
from adapter.report.trust import checks
from adapter.report.worth import Worth, worth_panels, worth_table
from adapter.runs.run_folder import RunData
from adapter.runs.score import TORQUE_GOAL

TEMPLATE = "report.html"


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
    figures, started, worth = data.figures, theta_started(data), Worth.of(data)
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
        "joints": [
            (j % JOINT_COLORS + 1, name) for j, name in enumerate(data.documented.tree.joint_names)
        ],
        "schema": schema_panels(data),
        "skeleton": skeleton_panels(data),
        "has_reference": has_reference(data),
        "started": started,
        "torque_goal": f"{TORQUE_GOAL:g}",
        "body_parts": BODY_PARTS,
        "bodies": body_panels(data) if started else [],
        "effects": effect_panels(data) if started else [],
        "prequential": prequential_panels(data) if started else [],
        "fit": fit_panels(data) if started else [],
        "fit_span": _fit_span(data) if started else "",
        "joint_tables": tables.joint_tables(data),
        "matrices": [tables.schema_matrix(data), tables.theta_matrix(data)],
        "changes": tables.changes_table(data),
        "refused": tables.refused_table(figures),
        "gaps": len(figures.get("gaps") or []),
        "warnings": _warnings(figures),
        "granted": [str(line) for line in figures.get("granted") or []],
        "speed": words.number(figures.get("times_real_time")),
        "timing": tables.timing_table(figures),
        "histograms": histogram_panels(figures),
        "tracking": tracking_table(figures),
        "theta_table": tables.theta_table(data),
        "schema_table": tables.schema_table(data),
        "provenance": tables.provenance_rows(data),
    }


def _warnings(figures: dict[str, Any]) -> list[str]:
    fault = figures.get("fault")
    ended = [f"The run ended early: {fault}"] if fault else []
    start_s = figures.get("start_s") or 0.0
    new = [f"New disagreement: {sentence(x, start_s)}" for x in words.not_learned(figures)]
    return [*ended, *new, *map(str, figures.get("warnings") or [])]


def _fit_span(data: RunData) -> str:
    t = data.times(data.score_trace)[fit_window(data)]
    return f"{words.number(t[0])} to {words.quantity(t[-1], 's')}" if len(t) else ""
