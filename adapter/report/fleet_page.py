"""The page of a fleet: arm by arm what holds, what drifts, and what each recording carried."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.catalogue import CATALOGUE
from adapter.report.fleet_words import EPOCH_S, HEADS, log_cells, sentences, summary
from adapter.report.html import fill, write_whole
from adapter.report.style import Drawing, Panel, joint_color
from adapter.report.tables import Table
from adapter.runs.fleet.arm import DAY_S, FleetArm
from adapter.runs.fleet.fleet import Fleet

TEMPLATE = "fleet.html"


@dataclass(frozen=True)
class ArmOnPage:
    """An arm's part of the page."""

    name: str
    lines: list[str]
    panels: list[Panel]
    logs: Table


def write_fleet_page(found: Fleet, path: str | Path) -> Path:
    """Write the page. Raises RunFolderError."""
    context: dict[str, Any] = {
        "headline": summary(found)[0],
        "arms": [_arm(arm) for arm in found.arms],
        "broken": Table(("recording", "why"), list(found.broken)),
        "forgotten": found.forgotten,
    }
    return write_whole(path, fill(TEMPLATE, context))


def _arm(arm: FleetArm) -> ArmOnPage:
    logs = Table(HEADS, [log_cells(log) for log in arm.logs])
    panels = _courses(arm) if len(arm.logs) > 1 else []
    return ArmOnPage(arm.name, sentences(arm), panels, logs)


def _courses(arm: FleetArm) -> list[Panel]:
    """What each recording alone says of friction and offsets, joint by joint, over their begins."""
    begin = np.array([log.moments.begin_s for log in arm.logs])
    days = (begin - begin.min()) / DAY_S
    label = "days after the first recording" if begin.min() > EPOCH_S else "days on the arm's clock"
    panels = []
    for k, name in enumerate(arm.effects):
        drawing = Drawing("half")
        ax = drawing.axes[0]
        for j in range(arm.logs[0].effects.shape[1]):
            y, std = (
                np.array([getattr(log, key)[k, j] for log in arm.logs])
                for key in ("effects", "effects_std")
            )
            ax.errorbar(days, y, std, color=joint_color(j), linewidth=1.0, elinewidth=0.6)
        ax.set_xlabel(label)
        effect = CATALOGUE[name]
        unit = effect.parameters[0].unit
        panels.append(drawing.panel(effect.title, unit, "by joint, with standard deviations"))
    return panels
