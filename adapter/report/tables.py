"""Tables of the report as plain rows of text: joints, identifiability, timing, what was refused."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adapter.effects.active import Active, active_effects
from adapter.effects.base import ALL, with_squares
from adapter.gap.phrases import SHOWN_UNITS
from adapter.judgement.priors import is_shown
from adapter.model.inertia import PARAMETERS, UNITS
from adapter.model.numbers import DASH
from adapter.model.tree import Tree
from adapter.physics.identifiability import SHOWN_ALONE
from adapter.report.learned_panels import theta_started
from adapter.report.words import REFUSALS, count, number, with_doubt
from adapter.runs.run_folder import RunData

LAMBDA_UNITS = ("rad", "rad", "rad", "m", "m", "m")
HIDDEN = 1e-6  # a share below it is none

TIMES = {
    "tick_us": "Driver, filter, synthesis",
    "loop_us": "The whole tick",
    "plant_us": "Physics of the simulated arm",
    "lateness_us": "Begin of the tick after its deadline",
    "period_us": "Period",
    "learner_us": "Update of the learner",
}
PERCENTILES = ("p50", "p99", "p99.9", "max")


@dataclass(frozen=True)
class Table:
    """Rows of text under column heads; `units` stand under the heads where given."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    units: Sequence[str] = ()
    note: str = ""


@dataclass(frozen=True)
class Tile:
    """A key figure: its name, its value, and what to hold it against."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Cell:
    """A cell of an identifiability matrix: "alone", "mixed" or "hidden", and its words."""

    kind: str
    words: str


@dataclass(frozen=True)
class Matrix:
    """Which parameters the data show: one row of cells per joint or link."""

    title: str
    summary: str
    heads: Sequence[str]
    rows: Sequence[tuple[str, Sequence[Cell]]] = field(default_factory=list)


def joint_tables(data: RunData) -> list[Table]:
    """One row per joint: errors, standard deviations and torque; in a second table effects."""
    schema, theta = data.figures["lambda"], data.figures["theta"]
    std = schema.get("std") or {}
    names = ("Joint", "", list(data.documented.tree.joint_names))
    torque = data.documented.tree.unit("N m", "N")
    columns: list[tuple[str, str, list[str]]] = [names]
    for head, unit, key, std_key, at in (
        ("Turn error", "mrad", "rotation_error_rad", "rotation_rad", slice(0, 3)),
        ("Shift error", "mm", "position_error_m", "position_m", slice(3, 6)),
    ):
        if schema.get(key):
            columns.append((head, unit, _column(schema[key], 1e3)))
        if std.get(std_key):
            pairs = zip(std[std_key], data.lam_shown, strict=True)
            known = [x if np.any(shown[at]) else None for x, shown in pairs]
            columns.append((f"± {head.split()[0].lower()}", unit, _column(known, 1e3)))
    if theta_started(data):
        measured = np.sqrt(np.mean(data.score_signals()[3] ** 2, axis=0))
        columns.append(("Torque, rms", torque, _column(measured)))
    if theta.get("torque_rmse_nm"):
        columns.append(("Not explained", f"{torque} rms", _column(theta["torque_rmse_nm"])))
    if theta.get("validation_torque_rmse_nm"):
        columns.append(("Held out", f"{torque} rms", _column(theta["validation_torque_rmse_nm"])))
    effects = effect_columns(active_effects(data.model.effects, data.n), data.model.tree)
    more = [(head, unit, cells) for (head, unit), cells in effects.items()]
    return [by_column(columns), *([by_column([names, *more])] if more else [])]


def by_column(columns: Sequence[tuple[str, str, list[str]]]) -> Table:
    """Columns (head, unit, cells)."""
    heads, units, cells = zip(*columns, strict=True)
    return Table(heads, list(zip(*cells, strict=True)), units)


def _column(values: Sequence[Any], scale: float = 1.0) -> list[str]:
    out = []
    for value in values:
        scaled = None if value is None else scale * value
        tiny = scaled is not None and 0.0 <= abs(scaled) < 1e-3
        out.append("< 0.001" if tiny else number(scaled))
    return out


def effect_columns(
    effects: Iterable[Active], tree: Tree, fitted: Collection[tuple[str, str]] | None = None
) -> dict[tuple[str, str], list[str]]:
    """Cells (n,) of each (head, unit): value ± standard deviation of effects by joint.

    One of all joints stands at each of them; one of the flange at none; what is the same of every
    joint was chosen or is not shown, and is left out. Of `fitted` (effect, key) alone, where they
    are given.
    """
    columns: dict[tuple[str, str], list[str]] = {}
    n = tree.n
    for active in effects:
        effect = active.effect
        joints = range(n) if effect.scope == ALL and active.joint < 0 else [active.joint]
        for key, value in active.values.items():
            left_out = fitted is not None and (effect.name, key) not in fitted
            if np.ndim(value) or joints[0] < 0 or left_out:
                continue
            slides = active.joint >= 0 and tree.slides[active.joint]
            given = effect.units(slides)[key]
            factor, unit = SHOWN_UNITS.get(given, (1.0, with_squares(given)))
            head = effect.name.replace("_", " ").capitalize()
            column = columns.setdefault((head, f"{key}, {unit}"), [DASH] * n)
            std = active.std.get(key)
            shown = "not shown"
            if is_shown(effect.name, key, std, slides):
                shown = with_doubt(factor * value, None if std is None else factor * std)
            for j in joints:
                column[j] = shown
    chosen = {head for head, cells in columns.items() if len({*cells}) == 1 and n > 1}
    return {head: cells for head, cells in columns.items() if head not in chosen}


def schema_matrix(data: RunData) -> Matrix:
    """Which turns and shifts of the frames the run's motion showed."""
    std, names = data.model.lam_std, data.documented.tree.joint_names
    rank = data.figures["lambda"].get("identifiable_rank")
    pairs = zip(names, data.lam_shown, std, strict=True)
    rows = [(name, list(map(_cell, shown, own, LAMBDA_UNITS))) for name, shown, own in pairs]
    names = tuple(f"{way} {axis}" for way in ("turn", "shift") for axis in "xyz")
    return Matrix("Body schema λ", f"{rank} of {6 * data.n} directions", names, rows)


def theta_matrix(data: RunData) -> Matrix:
    """Which inertial parameters torques can show."""
    std, names = data.model.theta_std[-data.n :], data.documented.tree.link_names
    rank = data.figures["theta"].get("base_parameters")
    started = theta_started(data)
    shares = data.theta_shown if started else np.zeros((len(names), 10))
    pairs = zip(names, shares, std, strict=True)
    rows = [(name, list(map(_cell, share, own, UNITS))) for name, share, own in pairs]
    summary = f"{rank} combinations of {10 * data.n} parameters"
    if not started:
        summary = f"none of {10 * data.n} parameters: θ was not learned"
    return Matrix("Dynamics θ", summary, PARAMETERS, rows)


def _cell(share: float, std: float, unit: str) -> Cell:
    if share > SHOWN_ALONE:
        return Cell("alone", f"identifiable, standard deviation {number(std, 2)} {unit}")
    if share > HIDDEN:
        return Cell("mixed", "identifiable only in combination with others")
    return Cell("hidden", "not identifiable, taken from the documentation")


def timing_table(figures: Mapping[str, Any]) -> Table | None:
    """Percentiles of whatever was timed, µs; None where nothing was."""
    timing = figures.get("timing") or {}
    timed = {key: timing.get(key) or figures.get(key) for key in (*TIMES, *timing, *figures)}
    rows = []
    for key, values in timed.items():
        known = values if key.endswith("_us") and isinstance(values, Mapping) else {}
        if any(known.get(name) is not None for name in PERCENTILES):
            rows.append([named(key), *(number(known.get(share)) for share in PERCENTILES)])
    units = ["", *["µs"] * len(PERCENTILES)]
    return Table(["", *PERCENTILES], rows, units) if rows else None


def named(key: str) -> str:
    """What was timed under a key of the figures."""
    return TIMES.get(key, key.removesuffix("_us").replace("_", " ").capitalize())


def refused_table(figures: Mapping[str, Any]) -> Table | None:
    """Samples that were not learned from, by reason; None where there were none."""
    refused = {key: value for key, value in (figures.get("refused") or {}).items() if value}
    if not refused:
        return None
    ordered = sorted(refused.items(), key=lambda item: -item[1])
    rows = [[key.replace("_", " "), count(x), REFUSALS.get(key, "")] for key, x in ordered]
    return Table(["Reason", "Samples", "Meaning"], rows)


CHANGE_HEADS = ("Seen at", "Load", "Centre of mass")
CHANGE_UNITS = ("s after the first motion", "kg", "mm, in the last link's frame")


def changes_table(data: RunData) -> Table | None:
    """Changes at the hand with what they brought; None where there were none."""
    changes = data.figures["theta"].get("changes") or []
    rows = [load_cells(x["stamp_s"] - data.start_s, x.get("payload") or {}) for x in changes]
    return Table(CHANGE_HEADS, rows, CHANGE_UNITS) if rows else None


def load_cells(at_s: float, load: Mapping[str, Any]) -> list[str]:
    """Since when, how heavy, where its centre is."""
    known = [1e3 * load[key] for key in ("cx", "cy", "cz") if load.get(key) is not None]
    centre = [f"{round(x, 1) + 0.0:.1f}".replace("-", "−") for x in known]
    mass = with_doubt(load["m"], load.get("m_std")) if load else DASH
    return [number(at_s, 4), mass, ", ".join(centre) or DASH]


def theta_table(data: RunData) -> Table:
    """θ in full, ± standard deviation where a parameter means something on its own."""
    rows = []
    for j, name in enumerate(data.documented.tree.link_names):
        theta, std = data.model.theta[-data.n :][j], data.model.theta_std[-data.n :][j]
        alone = data.theta_shown[j] > SHOWN_ALONE
        pairs = zip(theta, std, alone, strict=True)
        rows.append([name, *(with_doubt(x, s) if a else f"({number(x)})" for x, s, a in pairs)])
    note = (
        "In brackets: not identifiable on its own; of all possible bodies with the learned "
        "combinations those nearest to the documented ones."
    )
    return Table(["Link", *PARAMETERS], rows, ["", *UNITS], note)


def schema_table(data: RunData) -> Table:
    """λ in full, learned and documented."""
    rows = []
    for j, name in enumerate(data.documented.tree.joint_names):
        for what, lam in (("learned", data.model.lam), ("documented", data.documented.lam)):
            told = [f"{round(x, 4) + 0.0:.4f}".replace("-", "−") for x in lam[j]]
            rows.append([f"{name}, {what}", *told])
    note = (
        "R = Rz(α) Rx(β) Rz(γ). Angles of one frame may differ and mean the same frame; "
        "what motion does not show is taken from the documentation."
    )
    return Table(["Joint", "α", "β", "γ", "p x", "p y", "p z"], rows, ["", *LAMBDA_UNITS], note)


def provenance_rows(data: RunData) -> list[tuple[str, str, bool]]:
    """(name, text, whether it is long) of everything known of where the model came from."""
    rows = []
    for key, value in data.model.provenance.items():
        if key == "changes" or value is None:
            continue
        long = isinstance(value, Mapping | list)
        text = json.dumps(value, indent=1, ensure_ascii=False, default=str) if long else str(value)
        rows.append((key.replace("_", " ").capitalize(), text, long))
    return rows
