"""The paper's section IV on one self-contained page: its figures, and its numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from adapter.experiments.falls import SETS
from adapter.experiments.page import atlas_figures as figures
from adapter.experiments.page import words
from adapter.experiments.results import PAPER_BASELINES, AtlasResults, PandaResults, Stated
from adapter.gap.phrases import listed
from adapter.learning.batch.prediction_errors import LEAST_TORQUE
from adapter.model.numbers import DASH
from adapter.model.spatial import Array
from adapter.report import style
from adapter.report.html import fill
from adapter.report.learned_panels import FIRST_S, GROUPS, rotation_path
from adapter.report.tables import Table, Tile
from adapter.report.words import JOIN, NARROW
from adapter.runs.score import TORQUE_GOAL

BASELINES = (
    "the feed-forward network",
    "the committee of extreme learning machines",
    "the Gaussian process",
)


def render_experiment(atlas: AtlasResults | None, panda: PandaResults | None, written: str) -> str:
    """The page as HTML text; what was not run is left out, with a reason.

    Args:
        atlas: results of section IV.A.
        panda: results of section IV.B.
        written: who wrote this, when and where, for the foot of the page.

    Raises:
        ValueError: results whose shapes do not fit their tree.
    """
    return fill("experiment.html", context(atlas, panda, written), "adapter.experiments")


def context(atlas: AtlasResults | None, panda: PandaResults | None, written: str) -> dict[str, Any]:
    """What the template shows."""
    shown = [*(atlas_tiles(atlas) if atlas else []), *(panda_tiles(panda) if panda else [])]
    reasons = [words.ATLAS_LEFT_OUT] if atlas is None else _atlas_reasons(atlas)
    if panda is None:
        reasons.append(words.PANDA_LEFT_OUT)
    elif not math.isfinite(panda.theta_start_s):
        reasons.append("Fig. 6b: θ was not learned, it waits until λ has converged.")
    learned = None
    if panda is not None:
        torque, names = torque_panel(panda), panda.tree.joint_names
        learned = {
            "joints": [(j % style.JOINT_COLORS + 1, name) for j, name in enumerate(names)],
            "lambda": lambda_panels(panda),
            "theta": [*theta_panels(panda), *([torque] if torque else [])],
            "logarithmic": logarithmic(panda),
            "stated": stated_table(panda.stated),
        }
    return {
        "headline": words.headline(atlas, panda),
        "tiles": shown,
        "columns": max(len(shown), 1),
        "left_out": reasons,
        "atlas": None if atlas is None else _atlas(atlas),
        "panda": learned,
        "beyond": beyond(atlas, panda),
        "sets": list(figures.SET_NAMES.items()),
        "written": written,
    }


def atlas_tiles(atlas: AtlasResults) -> list[Tile]:
    """Key figures of section IV.A, those that there are."""
    value = words.percent(atlas.learners[0].median["control"])
    found = [Tile(f"{words.OURS}, control set", value, "median relative error, eq. 20")]
    best, times = words.best_baseline(atlas), words.advantage(atlas)
    if best is not None:
        value = words.percent(best.median["control"])
        found.append(Tile("Best baseline, control set", value, f"{best.name}; median, eq. 20"))
    if times is not None:
        note = f"times smaller on the arm, joints {arm_joints(atlas)}"
        found.append(Tile("Advantage", words.scientific(times), note))
    return found


def panda_tiles(panda: PandaResults) -> list[Tile]:
    """Key figures of section IV.B, those that there are."""
    after, ratio = words.converged(panda).ours, words.last_ratio(panda)
    value = "not reached" if after is None else words.with_unit(float(after), "s", 3)
    found = [Tile("λ of the simulated Panda converged", value, "after the first motion")]
    if ratio is not None:
        times = words.scientific(ratio, 3)
        found.append(Tile("Its torque error at the end", times, "times batch least squares"))
    return found


def _atlas(atlas: AtlasResults) -> dict[str, Any]:
    histogram, moments = figures.histogram_panels(atlas)
    paper, others = figures.arm_panels(atlas)
    names = {learner.name for learner in atlas.learners}
    summary = figures.side_by_side(atlas)
    tuning = [(x.name, x.title.rstrip("."), words.sentences(x.tuning)) for x in atlas.learners]
    return {
        "n": atlas.tree.n,
        "limbs": [(x.color % style.JOINT_COLORS + 1, x.name) for x in figures.limbs(atlas.tree)],
        "schema": [*figures.epoch_panels(atlas), histogram],
        "schema_more": [moments, *figures.schema_panels(atlas)],
        "not_converged": _not_converged(atlas),
        "paper": paper,
        "whole": figures.whole_panels(atlas),
        "others": others,
        "last": [figures.arm_panel(atlas), *([summary] if summary else [])],
        "arm": arm_joints(atlas),
        "not_judged": _not_judged(atlas),
        "compared": not names.isdisjoint(PAPER_BASELINES),
        "full": atlas.full,
        "stated": stated_table(atlas.stated),
        "learners": learner_table(atlas),
        "tuning": tuning,
    }


def arm_joints(atlas: AtlasResults) -> str:
    """The joints that the baselines learn, numbered from 1."""
    return f"{atlas.arm[0] + 1} to {atlas.arm[-1] + 1}"


def _not_converged(atlas: AtlasResults) -> str:
    """Which networks of Fig. 4 did not find their joint's frame; empty where all did."""
    names = atlas.not_converged
    if not names:
        return ""
    few = f"too few samples ({words.grouped(atlas.numbers['learned_samples'])})"
    if len(names) == atlas.tree.n:
        return f"None of the {atlas.tree.n} joints had converged; {few}."
    whose = f"{len(names)} joint{'' if len(names) == 1 else 's'} had not converged"
    return f"{whose}: {', '.join(names)}; {few}."


def _not_judged(atlas: AtlasResults) -> str:
    """Why some joints have no box in Fig. 5; empty where all have one."""
    joints = figures.not_judged(atlas)
    if not joints:
        return ""
    names = listed([f"{j + 1} ({atlas.tree.joint_names[j]})" for j in joints])
    which = f"Joint {names} has" if len(joints) == 1 else f"Joints {names} have"
    least = f"{LEAST_TORQUE:g} N m".replace(" ", NARROW)
    return (
        f"{which} no box: eq. 20 is judged only where |τ| > {least} (our choice, since relative "
        "errors of less say nothing), which is never exceeded there."
    )


def _atlas_reasons(atlas: AtlasResults) -> list[str]:
    """What of Figs. 4 and 5 is missing, and why."""
    kept = {label for label, _ in atlas.snapshots}
    names = {learner.name for learner in atlas.learners}
    return [
        *(
            f"Fig. 4{which}: λ's training has no {label}, it ended before."
            for label, which in figures.EPOCH_LETTERS.items()
            if label not in kept
        ),
        *(
            f"Fig. 5{words.LETTERS[name]}: {learner} was not run."
            for name, learner in zip(PAPER_BASELINES, BASELINES, strict=True)
            if name not in names
        ),
    ]


def stated_table(items: Sequence[Stated]) -> Table:
    """What the paper states, what we measured, what differs."""
    rows = [[x.what, x.paper or "not stated", words.ours_text(x), x.note] for x in items]
    return Table(["", "Paper states", "We measured", "Remark"], rows)


def learner_table(atlas: AtlasResults) -> Table:
    """A row per learner and set: errors, and how long it trained."""
    heads = ["Learner", "Joints", "Training", "Set", "Median", "99th percentile", "RMSE"]
    units = ["", "", "", "", "eq. 20", "eq. 20", "by joint, N m"]
    rows = []
    for learner in atlas.learners:
        joints, train = str(len(learner.rmse[SETS[0]])), words.with_unit(learner.train_s, "s", 3)
        row = [learner.name, joints, train]
        for name in SETS:
            errors = map(words.percent, (learner.median[name], learner.p99[name]))
            rows.append([*row, name, *errors, _spread(learner.rmse[name])])
            row = [""] * len(row)
    return Table(heads, rows, units)


def _spread(values: Array) -> str:
    """Smallest to largest over the joints."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return DASH
    low, high = words.scientific(float(finite.min())), words.scientific(float(finite.max()))
    return low if low == high else f"{low}{NARROW}–{JOIN}{NARROW}{high}"


SECONDS = "seconds of motion learned from"
Line = tuple[str, Array, str]  # name, values, colour


def beyond(atlas: AtlasResults | None, panda: PandaResults | None) -> dict[str, Any] | None:
    """Tables and panels of the section; None where neither was run."""
    ran = {name: x.numbers["discover"] for name, x in (("ATLAS", atlas), ("Panda", panda)) if x}
    robots = [(name, found) for name, found in ran.items() if found["trials"]]
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
    wrong = [found["most_confidence_wrong"] or None for found in trials]
    kinds = ([figures.KINDS[kind][0] for kind in x["measured"].split(", ")] for x in trials)

    def share(confidence: float | None) -> str:  # never rounded up to certainty
        if confidence is None:
            return "none was reported"
        return f"{math.floor(1e4 * confidence) / 1e4:.4f}"

    rows = [
        ["trees found, every edge right", *(f"{x['right']} of {x['trials']}" for x in trials)],
        ["least confidence in a right edge", *(share(x["least_confidence_right"]) for x in trials)],
        ["most confidence in a wrong edge", *map(share, wrong)],
        ["longest recording", *(words.with_unit(x["motion_s"], "s", 3) for x in trials)],
        ["measured on every link", *map(listed, kinds)],
    ]
    return Table(["", *(name for name, _ in robots)], rows)


def online_table(online: Mapping[str, Any]) -> Table | None:
    """How fast the online learner is on the whole tree, and what it shows; None without any."""
    if not online:
        return None
    settled_s = online["lambda_settled_s"]
    settled = "not reached" if settled_s is None else words.with_unit(settled_s, "s", 3)
    steps = [
        words.with_unit(1e-3 * us, "ms", 3) if us >= 1e3 else words.with_unit(us, "µs", 3)
        for us in (online["step_p50_us"], online["step_p99_us"])
    ]
    rows = [
        ["samples a second, on one core", words.with_unit(online["samples_per_second"], "1/s", 3)],
        ["time of a sample, median", steps[0]],
        ["time of a sample, 99th percentile", steps[1]],
        ["λ settled, θ begins after", settled],
        ["directions of λ shown", f"{online['lambda_rank']} of {6 * online['joints']}"],
    ]
    return Table(["", "ATLAS"], rows)


def online_panels(history: Sequence[Mapping[str, float]]) -> list[style.Panel]:
    """Torque error over least squares', and λ's error, against seconds learned from."""
    if not history:
        return []
    over = {key: np.array([row[key] for row in history]) for key in history[0]}
    t = over["seconds"]
    worst = "worst joint", over["worst_joint_over_least_squares"], style.MUTED
    every = "all joints", over["over_least_squares"], style.ACCENT
    ratios = _plot(t, [every, worst], TORQUE_GOAL)
    shift = "shift, m", over["shift_m"], style.GOAL
    errors = _plot(t, [("turn, rad", over["turn_rad"], style.ACCENT), shift], None)
    note = "on a motion never learned from; 1 is least squares on all samples seen so far"
    far = "of the joint whose frame is farthest off"
    return [
        ratios.panel("ATLAS online: torque error", "times batch least squares", note),
        errors.panel("ATLAS online: error of λ", "rad, m", far),
    ]


def _plot(t: Array, lines: Sequence[Line], goal: float | None) -> style.Drawing:
    """Lines with a dot at each look, from zero on."""
    drawing = style.Drawing("half")
    ax = drawing.axes[0]
    shown = np.concatenate([values for _, values, _ in lines])
    shown = shown[np.isfinite(shown) & (shown > 0.0)]
    for name, values, color in lines:
        ax.plot(t, values, color=color, linewidth=1.2, marker="o", markersize=2.8, label=name)
    if len(shown):
        low, high = float(shown.min()), max(float(shown.max()), goal or 0.0)
        if goal is None or high > 10.0 * low:  # less is plotted linearly
            style.log_axis(ax, 0.5 * min(low, goal or low), 4.0 * high)
        else:
            ax.set_ylim(0.0, 1.35 * high)
    ax.set_xlim(0.0, 1.04 * float(t[-1]))
    if goal is not None:
        style.level(ax, goal, f"goal {words.scientific(goal)}", left=True)
    style.legend(ax, fontsize=style.SIZES["half"][2], loc="upper right", ncols=2)
    style.time_axis(drawing, SECONDS)
    return drawing


TITLES = (
    ("(a) λ: orientation of the joint frames", "rad", slice(0, 3)),
    ("(a) λ: position of the joint frames", "m", slice(3, 6)),
)


def lambda_panels(panda: PandaResults) -> list[style.Panel]:
    """One line per turn and shift of every joint frame (Fig. 6a), the true values dashed."""
    t, lam = _some(panda, panda.time_s, panda.lam)
    if len(t) < 2:
        return []
    path, true = turns_and_shifts(lam, panda.lam_true)
    panels = []
    for title, unit, part in TITLES:
        drawing = style.Drawing("half")
        ax = drawing.axes[0]
        for j in range(panda.tree.n):
            for k in range(part.start, part.stop):
                shown = bool(panda.lam_shown[j, k])
                width, alpha = (1.2, 1.0) if shown else (0.7, 0.45)
                ax.plot(t, path[:, j, k], color=style.joint_color(j), linewidth=width, alpha=alpha)
                if shown:
                    ax.axhline(true[j, k], color=style.INK, linewidth=0.6, linestyle=(0, (4, 3)))
        _finish(drawing, t, panda)
        what = "rotation vectors" if unit == "rad" else "origins"
        panels.append(drawing.panel(title, unit, f"{what}, x, y and z in the parent's axes"))
    return panels


def theta_panels(panda: PandaResults) -> list[style.Panel]:
    """One line per inertial parameter of every link (Fig. 6b), by kind."""
    t, theta = _some(panda, panda.theta_time_s, panda.theta)
    if len(t) < 2:
        return []
    panels, titles = [], ("mass", "first moments mX mY mZ", "inertia XX to ZZ")
    for title, (unit, parts) in zip(titles, GROUPS, strict=True):
        drawing = style.Drawing("half")
        for j in range(panda.tree.n):
            drawing.axes[0].plot(t, theta[:, j, parts], color=style.joint_color(j), linewidth=1.0)
        _finish(drawing, t, panda)
        panels.append(drawing.panel(f"(b) θ: {title}", unit))
    return panels


def torque_panel(panda: PandaResults) -> style.Panel | None:
    """Torque error over that of batch least squares; None where θ was not learned."""
    t, ratio = np.asarray(panda.torque_time_s, float), np.asarray(panda.torque_error, float)
    good = np.isfinite(ratio) & (ratio > 0.0) & (t >= _first(panda))
    t, ratio = t[good], ratio[good]
    if len(t) < 2:
        return None
    drawing = style.Drawing("half")
    ax = drawing.axes[0]
    ax.plot(*style.thin(t, ratio), color=style.ACCENT, linewidth=1.3)
    low, high = float(ratio.min()), float(ratio.max())
    if high > 10.0 * low:
        style.log_axis(ax, 0.7 * min(low, 1.0), 1.5 * high)
    else:
        ax.set_ylim(0.0, 1.15 * max(high, TORQUE_GOAL))
    _finish(drawing, t, panda)
    style.level(ax, TORQUE_GOAL, f"goal {TORQUE_GOAL:g}", left=False)
    note = "of each sample before it was learned from; 1 is least squares on all samples"
    return drawing.panel("Torque error while learning", "times batch least squares", note)


def logarithmic(panda: PandaResults) -> bool:
    """Whether time is drawn logarithmic: what there is to see comes early."""
    return not panda.theta_start_s > 0.2 * float(panda.time_s[-1])


def _first(panda: PandaResults) -> float:
    """The earliest time that is drawn, s."""
    return FIRST_S if logarithmic(panda) else 0.0


def _some(panda: PandaResults, t: Array, rows: Array) -> tuple[Array, Array]:
    """At most about `MOST_POINTS` finite rows, evenly over the time axis."""
    t, rows = np.asarray(t, float), np.asarray(rows, float)
    good = np.isfinite(rows).reshape(len(rows), -1).all(axis=1) & (t >= _first(panda))
    t, rows = t[good], rows[good]
    if len(t) <= style.MOST_POINTS:
        return t, rows
    space = np.geomspace if logarithmic(panda) else np.linspace
    keep = np.unique(np.searchsorted(t, space(t[0], t[-1], style.MOST_POINTS)).clip(0, len(t) - 1))
    return t[keep], rows[keep]


def turns_and_shifts(lam: Array, true: Array) -> tuple[Array, Array]:
    """(k, n, 6) rotation vectors and origins over time, and the true ones (n, 6), of the two
    rotation vectors that mean the same turn the one nearer to what was learned."""
    both = np.concatenate([lam, true[None]])
    path = np.concatenate([rotation_path(both), both[..., 3:]], axis=-1)
    return path[:-1], path[-1]


def _finish(drawing: style.Drawing, t: Array, panda: PandaResults) -> None:
    ax: Axes = drawing.axes[0]
    if ax.get_yscale() == "linear":
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.08 * (high - low))  # room for the words of the mark
    last = max(float(panda.time_s[-1]), float(t[-1]))
    if logarithmic(panda):
        style.log_time(ax, FIRST_S, last)
    else:
        ax.set_xlim(0.0, last)
    style.mark(ax, panda.theta_start_s, "θ starts")
    style.time_axis(drawing)
