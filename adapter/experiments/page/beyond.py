"""What the paper leaves for later: trees found from signals alone, and ATLAS learned online."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adapter.experiments.page.atlas_figures import KINDS
from adapter.experiments.page.words import scientific, with_unit
from adapter.experiments.results import AtlasResults, PandaResults
from adapter.gap.phrases import listed
from adapter.model.spatial import Array
from adapter.report.style import (
    ACCENT,
    GOAL,
    MUTED,
    SIZES,
    Drawing,
    Panel,
    legend,
    level,
    log_axis,
    time_axis,
)
from adapter.report.tables import Table
from adapter.runs.score import TORQUE_GOAL

SECONDS = "seconds of motion learned from"
Line = tuple[str, Array, str]  # name, values, colour


def beyond(atlas: AtlasResults | None, panda: PandaResults | None) -> dict[str, Any] | None:
    """Tables and panels of the section; None where neither was run."""
    robots = [
        (name, results.numbers["discover"])
        for name, results in (("ATLAS", atlas), ("Panda", panda))
        if results is not None and results.numbers["discover"]["trials"]
    ]
    online = {} if atlas is None else atlas.numbers["online"]
    if not robots and not online:
        return None
    return {
        "trees": tree_table(robots),
        "online": online_table(online),
        "panels": online_panels(online.get("history", [])),
    }


def tree_table(robots: Sequence[tuple[str, Mapping[str, Any]]]) -> Table | None:
    """Of each robot how many trees were found, and how sure of them discovery was."""
    if not robots:
        return None
    trials = [found for _, found in robots]
    wrong = [found["most_confidence_wrong"] for found in trials]
    rows: list[tuple[str, list[str]]] = [
        ("trees found, every edge right", [f"{x['right']} of {x['trials']}" for x in trials]),
        ("least confidence in a right edge", [_share(x["least_confidence_right"]) for x in trials]),
        (
            "most confidence in a wrong edge",
            [_share(x) if x > 0.0 else "none was reported" for x in wrong],
        ),
        ("longest recording", [with_unit(x["motion_s"], "s", 3) for x in trials]),
        (
            "measured on every link",
            [listed([KINDS[kind][0] for kind in x["measured"].split(", ")]) for x in trials],
        ),
    ]
    return Table(["", *(name for name, _ in robots)], [[what, *cells] for what, cells in rows])


def _share(confidence: float) -> str:
    """Never rounded up to certainty."""
    return f"{math.floor(1e4 * confidence) / 1e4:.4f}"


def online_table(online: Mapping[str, Any]) -> Table | None:
    """How fast the online learner is on the whole tree, and what it shows; None without any."""
    if not online:
        return None
    settled_s = online["lambda_settled_s"]
    settled = "not reached" if settled_s is None else with_unit(settled_s, "s", 3)
    steps = [
        with_unit(1e-3 * us, "ms", 3) if us >= 1e3 else with_unit(us, "µs", 3)
        for us in (online["step_p50_us"], online["step_p99_us"])
    ]
    rows = [
        ["samples a second, on one core", with_unit(online["samples_per_second"], "1/s", 3)],
        ["time of a sample, median", steps[0]],
        ["time of a sample, 99th percentile", steps[1]],
        ["λ settled, θ begins after", settled],
        ["directions of λ shown", f"{online['lambda_rank']} of {6 * online['joints']}"],
    ]
    return Table(["", "ATLAS"], rows)


def online_panels(history: Sequence[Mapping[str, float]]) -> list[Panel]:
    """Torque error over least squares', and λ's error, against seconds learned from."""
    if not history:
        return []
    over = {key: np.array([row[key] for row in history]) for key in history[0]}
    t = over["seconds"]
    ratios: list[Line] = [
        ("all joints", over["over_least_squares"], ACCENT),
        ("worst joint", over["worst_joint_over_least_squares"], MUTED),
    ]
    errors: list[Line] = [
        ("turn, rad", over["turn_rad"], ACCENT),
        ("shift, m", over["shift_m"], GOAL),
    ]
    note = "on a motion never learned from; 1 is least squares on all samples seen so far"
    return [
        _plot(t, ratios, TORQUE_GOAL).panel(
            "ATLAS online: torque error", "times batch least squares", note
        ),
        _plot(t, errors, None).panel(
            "ATLAS online: error of λ", "rad, m", "of the joint whose frame is farthest off"
        ),
    ]


def _plot(t: Array, lines: Sequence[Line], goal: float | None) -> Drawing:
    """Lines with a dot at each look, from zero on."""
    drawing = Drawing("half")
    ax = drawing.axes[0]
    shown = np.concatenate([values for _, values, _ in lines])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    for name, values, color in lines:
        ax.plot(t, values, color=color, linewidth=1.2, marker="o", markersize=2.8, label=name)
    if len(shown):
        low, high = float(shown.min()), max(float(shown.max()), goal or 0.0)
        if goal is None or high > 10.0 * low:  # less is plotted linearly
            log_axis(ax, 0.5 * min(low, goal or low), 4.0 * high)
        else:
            ax.set_ylim(0.0, 1.35 * high)
    ax.set_xlim(0.0, 1.04 * float(t[-1]))
    if goal is not None:
        level(ax, goal, f"goal {scientific(goal)}", left=True)
    legend(ax, fontsize=SIZES["half"][2], loc="upper right", ncols=2)
    time_axis(drawing, SECONDS)
    return drawing
