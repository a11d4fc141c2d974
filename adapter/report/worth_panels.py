"""What the learned model is worth joint by joint: a table, and errors before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.model.numbers import DASH
from adapter.report.gap_panels import fall_drawing
from adapter.report.headline import Worth
from adapter.report.style import Panel
from adapter.report.tables import Table
from adapter.report.words import number, with_doubt
from adapter.report.worth import Fall
from adapter.runs.run_folder import RunData


def worth_table(data: RunData, worth: Worth) -> Table | None:
    """One row per joint: torque and tracking errors before and after; None where neither is
    known."""
    columns: list[tuple[str, str, list[str]]] = []
    torque, tracking = worth.torque, worth.tracking
    if torque is not None:
        if torque.size is not None:
            columns.append(("Torque that acted", "N m rms", [number(x) for x in torque.size]))
        if torque.before is not None:
            shown = _values(torque.before, torque.before_std)
            columns.append(("Error, documented model", "N m rms", shown))
        shown = _values(torque.after, torque.after_std)
        columns.append(("Error, learned model", "N m rms", shown))
        if torque.before is not None:
            columns.append(("Change", "", _changes(torque)))
    if tracking is not None and tracking.before is not None:
        columns.append(("Path error, feedback alone", "mrad rms", _values(1e3 * tracking.before)))
        columns.append(("Path error, with model", "mrad rms", _values(1e3 * tracking.after)))
    if not columns:
        return None
    heads, units, cells = zip(
        ("Joint", "", list(data.documented.tree.joint_names)), *columns, strict=True
    )
    return Table(heads, list(zip(*cells, strict=True)), units)


def _values(values: Any, std: Any = None) -> list[str]:
    doubts = [None] * len(values) if std is None else std
    return [with_doubt(x, s) for x, s in zip(values, doubts, strict=True)]


def _changes(fall: Fall) -> list[str]:
    assert fall.before is not None
    shares = 100.0 * (fall.after / np.maximum(fall.before, 1e-12) - 1.0)
    return [f"{x:+.0f} %".replace("-", "−") if np.isfinite(x) else DASH for x in shares]


def worth_panels(data: RunData, worth: Worth) -> list[Panel]:
    """Errors of every joint before and after, where both are known."""
    panels = []
    torque, tracking = worth.torque, worth.tracking
    names = data.documented.tree.joint_names
    if torque is not None and torque.before is not None:
        drawing = fall_drawing(torque.before, torque.after, None, names)
        panels.append(drawing.panel("Torque error by joint", "N m rms", torque.seen))
    if tracking is not None and tracking.before is not None:
        drawing = fall_drawing(1e3 * tracking.before, 1e3 * tracking.after, None, names)
        note = f"feedback alone, and with the feed-forward of the {tracking.seen}"
        panels.append(drawing.panel("Path error by joint", "mrad rms", note))
    return panels
