"""The page of a fleet: arm by arm what holds, what drifts, and what each recording carried."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.catalogue import KNOWN
from adapter.report.fleet_words import EPOCH_S, HEADS, log_cells, sentences, summary, to_be_shown
from adapter.report.html import fill, write_whole
from adapter.report.style import Drawing, Panel, joint_color, legend
from adapter.report.tables import Table
from adapter.report.words import with_doubt
from adapter.runs.fleet.arm import DAY_S, FleetArm, OfLog
from adapter.runs.fleet.fleet import Fleet

MOST_ROWS = 300  # of recordings; of more those that there is something to say of
LEAST_STD = 1e-9  # below it nothing was learned, it is rounding


def write_fleet_page(found: Fleet, path: str | Path) -> Path:
    """Write the page. Raises RunFolderError."""
    context: dict[str, Any] = {
        "headline": summary(found)[0],
        "arms": [_arm(arm) for arm in found.arms],
        "broken": Table(("recording", "why"), list(found.broken)),
        "forgotten": found.forgotten,
    }
    return write_whole(path, fill("fleet.html", context))


def _arm(arm: FleetArm) -> dict[str, Any]:
    """An arm's part of the page."""
    numbers = to_be_shown(arm, MOST_ROWS)
    left = len(arm.logs) - len(numbers)
    note = f"{left} more in the table file; here are those there is something to say of"
    logs = Table(HEADS, [log_cells(arm.logs[k]) for k in numbers], note=note * (left > 0))
    used = [x for x in arm.logs if x.used]
    panels = _courses(arm, used) if len(used) > 1 else []
    told = {"name": arm.name, "lines": sentences(arm), "parameters": _parameters(arm)}
    return {**told, "panels": panels, "logs": logs}


def _parameters(arm: FleetArm) -> Table:
    """What is learned of each joint and of the link that it moves; θ whole is in the model file."""
    heads = ["joint", "mass of its link", *(KNOWN[name].title for name in arm.effects)]
    units = ["", "kg", *(KNOWN[name].parameters[0].written for name in arm.effects)]
    std = arm.outcome.effects_std
    links = len(arm.model.theta) - arm.model.tree.n  # a base that floats comes first
    rows = []
    for j, name in enumerate(arm.model.tree.joint_names):
        shown = arm.model.theta_std[links + j, 0] > LEAST_STD
        mass = arm.model.theta[links + j, 0], arm.model.theta_std[links + j, 0] if shown else None
        values = [with_doubt(arm.outcome.effects[k, j], std[k, j]) for k in range(len(std))]
        rows.append([name, with_doubt(*mass), *values])
    note = (
        "A mass without a standard deviation is the documentation's: torques show it in sums only."
    )
    return Table(heads, rows, units, note)


def _courses(arm: FleetArm, used: list[OfLog]) -> list[Panel]:
    """What each recording alone says of friction and offsets, joint by joint, over their begins."""
    begin = np.array([log.moments.begin_s for log in used])
    days = (begin - begin.min()) / DAY_S
    label = "days after the first recording" if begin.min() > EPOCH_S else "days on the arm's clock"
    panels = []
    for k, name in enumerate(arm.effects):
        drawing = Drawing("half")
        ax = drawing.axes[0]
        for j in range(used[0].effects.shape[1]):
            y, std = (
                np.array([getattr(log, key)[k, j] for log in used])
                for key in ("effects", "effects_std")
            )
            look = ax.errorbar(days, y, std, color=joint_color(j), linewidth=1.0, elinewidth=0.6)
            look.set_label(str(j + 1))
        legend(ax, ncols=8, fontsize=6, loc="lower center", bbox_to_anchor=(0.5, 0.98))
        drawing.figure.subplots_adjust(top=0.9)  # for the legend
        ax.set_xlabel(label)
        effect = KNOWN[name]
        unit = effect.parameters[0].written
        panels.append(drawing.panel(effect.title, unit, "by joint, with standard deviations"))
    return panels
