"""What was found and what it is worth: torque and tracking errors before and after, loads.

As numbers, as tables joint by joint, and as panels; a simulated arm's truth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.effects.active import active_effects
from adapter.effects.catalogue import KNOWN
from adapter.effects.torque import ModelTorque
from adapter.gap.result import Finding
from adapter.model.numbers import DASH
from adapter.model.self_model import LAMBDA_MEASURED, SelfModel
from adapter.model.spatial import Array
from adapter.report.gap_panels import fall_drawing
from adapter.report.learned_panels import change_times, theta_started
from adapter.report.skeleton import placed_arm, some_postures
from adapter.report.style import Panel
from adapter.report.tables import (
    CHANGE_HEADS,
    CHANGE_UNITS,
    Table,
    by_column,
    changes_table,
    effect_columns,
    load_cells,
)
from adapter.report.words import number, with_doubt
from adapter.runs.run_folder import RunData
from adapter.runs.score import stamps_s
from adapter.signals.validation import rms_of

FEWEST_ROWS = 50
BLOCK_S, FEWEST_BLOCKS = 0.5, 8  # what lasts longer than a block is slow
SLOW = 0.3  # share from which what is left is not called noise
SETTLING_S = 2.0  # after a change at the hand, or where nothing says when θ had converged
BETTER, WORSE = 0.9, 1.1  # times the error before: from here on it is called a change


@dataclass(frozen=True)
class Fall:
    """An error by joint before and after, of what nobody had fitted to the rows it is judged on.

    Attributes:
        before, after: (n,) rms; None where nothing is known of it.
        before_std, after_std: (n,) of these, from the spread between stretches of the recording.
        size: (n,) rms of the quantity itself.
        seen: how the rows after stand to the fit: "predicted before it was learned from".
    """

    before: Array | None
    after: Array
    before_std: Array | None
    after_std: Array | None
    size: Array | None
    seen: str

    @property
    def better(self) -> bool:
        """Whether the error of all joints is clearly smaller than before."""
        return self.before is not None and together(self.after) < BETTER * together(self.before)

    @property
    def worse(self) -> bool:
        """Whether it is clearly larger."""
        return self.before is not None and together(self.after) > WORSE * together(self.before)


def together(values: Array) -> float:
    """Root of the sum of squares over the joints."""
    return float(np.sqrt(np.sum(np.asarray(values, dtype=float) ** 2)))


def torque_fall(data: RunData) -> Fall | None:
    """Torque errors of the documented and of the learned model, N m; None where θ was not learned.

    On data held out where there are any; else on rows that were predicted before they were learned
    from, once θ had converged and after the last change at the hand.
    """
    theta = data.figures["theta"]
    if not theta_started(data) or not theta.get("torque_rmse_nm"):
        return None
    q, dq, ddq, tau, error = data.score_signals()
    held_out = theta.get("validation_torque_rmse_nm")
    size = rms_of([tau]).value
    if held_out:
        keys = "validation_torque_rmse_nm", "validation_torque_rmse_std_nm"
        before, before_std = (_known(theta.get(f"documented_{key}")) for key in keys)
        after_std = _known(theta.get(keys[1]))
        seen = "on data held out"
        return Fall(before, np.array(held_out, float), before_std, after_std, size, seen)
    t, converged = data.times(data.score_trace), data.converged_s("theta")
    rows = (t >= (t[0] + SETTLING_S if converged is None else converged)) & fit_rows(data)
    if rows.sum() < FEWEST_ROWS:
        return None
    after, seen = rms_of([error[rows]]), "predicted before it was learned from"
    if data.documented.tree.floating:  # the base's motion is not kept for the page
        return Fall(None, after.value, None, after.std, size, seen)
    documented = ModelTorque(data.documented)(q, dq, ddq, t)
    first = rms_of([(tau - documented)[rows]])
    return Fall(first.value, after.value, first.std, after.std, size, seen)


def _known(values: Any) -> Array | None:
    return None if values is None else np.array(values, float)


def fit_rows(data: RunData) -> NDArray[np.bool_]:
    """(k,) bool: rows of the score that the learned model is of: after the last change."""
    t, changes = data.times(data.score_trace), change_times(data)
    return np.asarray(t >= changes[-1] + SETTLING_S) if changes else np.ones(len(t), dtype=bool)


def slow_share(data: RunData) -> Array | None:
    """(n,) share of the power of what the learned model leaves that lasts over `BLOCK_S`, that is
    the power of its means over so long; None where there are too few.

    Of noise behind the filter up to 0.16 was seen in 2 to 17 s (0.02 with little filtering), of
    the logs of real arms 0.36 and more.
    """
    rows = fit_rows(data)
    left, t = (data.score_signals()[3] - data.fit)[rows], data.times(data.score_trace)[rows]
    if len(t) < FEWEST_ROWS or t[-1] - t[0] < FEWEST_BLOCKS * BLOCK_S:
        return None
    block = ((t - t[0]) / BLOCK_S).astype(int)
    count = np.bincount(block)
    full = count >= 0.5 * np.median(count[count > 0])
    sums = np.stack([np.bincount(block, weights=x) for x in left.T], axis=1)
    means = sums[full] / count[full, None]
    return np.asarray(means.var(axis=0) / np.maximum(left.var(axis=0), 1e-18))


def tracking_fall(figures: Mapping[str, Any]) -> Fall | None:
    """Tracking errors, rad, by feedback alone and with the model; None where not both are known."""
    tracking = figures.get("tracking") or {}
    alone, with_model = (tracking.get(key) or {} for key in ("feedback", "feedforward"))
    if not alone.get("rms_rad") or not with_model.get("rms_rad"):
        return None
    before, after = (np.array(x["rms_rad"], float) for x in (alone, with_model))
    return Fall(before, after, None, None, None, f"{figures.get('feedforward')} model")


def hand_off_m(data: RunData) -> float | None:
    """How far (rms over postures of the run, m) the outermost link stands from where the
    documentation puts it; None where no posture or no such link is known."""
    q = some_postures(data)
    both = data.documented.lam, data.model.lam
    tips = zip(*([placed_arm(data, lam, row).tips for row in q] for lam in both), strict=True)
    apart = [np.linalg.norm(there[j] - here[j]) for there, here in tips for j in there]
    return float(np.sqrt(np.mean(np.square(apart)))) if apart else None


@dataclass(frozen=True)
class Worth:
    """What a run brought: errors before and after, how far off the hand stood, the loads found.

    Attributes:
        loads: (when, s after the first motion, kg, its standard deviation).
        lacks: effects that were learned surely and that add more to their joint's torque than
            the learned model leaves there.
        bodies_nm: (n,) rms of what the links' other inertias, loads left out, change of the
            torques; None where nobody knows.
    """

    torque: Fall | None
    tracking: Fall | None
    hand_m: float | None
    loads: list[tuple[float, float, float | None]]
    lacks: list[Finding] = field(default_factory=list)
    bodies_nm: Array | None = None

    @classmethod
    def of(cls, data: RunData) -> Worth:
        """Of a run."""
        measured = data.figures["lambda"].get("source") == LAMBDA_MEASURED
        hand_m = hand_off_m(data) if measured else None
        changes = [change.get("payload") for change in data.figures["theta"].get("changes") or []]
        pairs = zip(change_times(data), changes, strict=True)
        loads = [(at_s, load["m"], load.get("m_std")) for at_s, load in pairs if load]
        fall = torque_fall(data)
        worth = cls(fall, tracking_fall(data.figures), hand_m, loads)
        known = fall is not None and fall.before is not None
        if fall is None or not known or not data.figures["theta"].get("settled", True):
            return worth
        held = [load for load in (data.figures["theta"].get("held"), *changes[-1:]) if load]
        return replace(worth, lacks=_lacks(data, fall), bodies_nm=_bodies(data, held))


def _torque(data: RunData, model: SelfModel, own_log: bool = False) -> Array:
    """(k, n) N m of a model on the motion that the learned one is judged on."""
    rows = fit_rows(data)
    q, dq, ddq = (x[rows] for x in data.score_signals()[:3])
    t = stamps_s(data.score_trace)[rows]
    return ModelTorque(model, own_log=own_log)(q, dq, ddq, t)


def _lacks(data: RunData, fall: Fall) -> list[Finding]:
    """As `Worth` has them, each kind weighed by itself on the documented arm."""
    n, there, found = data.n, data.documented.effects, []
    documented = {entry["effect"] for entry in there}
    first, names = _torque(data, data.documented), {e["effect"] for e in data.model.effects}
    for name in sorted(names - documented):
        own = tuple(entry for entry in data.model.effects if entry["effect"] == name)
        size = _torque(data, replace(data.documented, effects=(*there, *own))) - first
        rms, effect = rms_of([size]).value, KNOWN[name]
        found += [
            Finding(
                effect=name,
                title=effect.title,
                joints=(x.joint + 1,),
                interval_s=(0.0, np.inf),
                lasting=True,
                parameters=dict(x.values),
                std=dict(x.std),
                units=effect.units(data.model.tree.slides[x.joint]),
                evidence=np.nan,
                overlaps={},
                split_by="",
                detectability=np.nan,
                torque_rms_nm=np.where(np.arange(n) == x.joint, rms, 0.0),
            )
            for x in active_effects(own, n)
            if x.joint >= 0 and x.shown and rms[x.joint] > fall.after[x.joint]
        ]
    return found


def _bodies(data: RunData, held: list[Mapping[str, Any]]) -> Array:
    """(n,) N m rms of what links change that weigh otherwise than documented, beside loads."""
    told = [{key: load[key] for key in ("m", "cx", "cy", "cz")} for load in held]
    loads = tuple({"effect": "payload", "parameters": parameters} for parameters in told)
    before = replace(data.documented, effects=(*data.documented.effects, *loads))
    after = replace(data.documented, theta=data.model.theta)
    return rms_of([_torque(data, after) - _torque(data, before)]).value


def truth_tables(data: RunData) -> list[Table]:
    """What is true of a simulated arm beside what was learned, joint by joint; none of another."""
    truth = data.figures.get("truth")
    if truth is None or data.documented.tree.floating:
        return []
    n, names = data.n, ("Joint", "", list(data.documented.tree.joint_names))
    entries = [entry for entry in truth["effects"] if entry["effect"] in KNOWN]
    theta = np.array(data.documented.theta)
    theta[-n:] = truth["theta"]
    lam, gravity = np.array(truth["lambda"]), np.array(truth["gravity"])
    arm = replace(data.documented, lam=lam, theta=theta, gravity=gravity, effects=tuple(entries))
    true = _torque(data, arm, own_log=True)
    torque: list[tuple[str, str, list[str]]] = []
    for name, model in (("Documented", data.documented), ("Learned", data.model)):
        off = rms_of([_torque(data, model) - true]).value
        torque.append((f"{name} model off by", "N m rms", [number(x, 2) for x in off]))
    fitted = {(e["effect"], key) for e in data.model.effects for key in e.get("std") or ()}
    learned = effect_columns(active_effects(data.model.effects, n), data.model.tree, fitted)
    columns, true_of = [], effect_columns(active_effects(entries, n), data.model.tree, fitted)
    for (head, unit), cells in true_of.items():
        columns += [(head, unit, learned.get((head, unit), [DASH] * n)), ("in truth", unit, cells)]
    tables = [by_column([names, *torque]), *([by_column([names, *columns])] if columns else [])]
    held = [x for x in entries if x["effect"] == "payload"]
    at_s = [(x["interval_s"] or [0.0])[0] - data.start_s for x in held]
    told = (load_cells(at, x["parameters"]) for at, x in zip(at_s, held, strict=True))
    loads, found = [["in truth", *x] for x in told], changes_table(data)
    rows = [*(["learned", *row] for row in (found.rows if found else ())), *loads]
    return [*tables, *([Table(["", *CHANGE_HEADS], rows, ["", *CHANGE_UNITS])] if rows else [])]


def worth_table(data: RunData, worth: Worth) -> Table | None:
    """One row per joint: torque and tracking errors before and after; None where neither is
    known."""
    columns: list[tuple[str, str, list[str]]] = []
    torque, tracking, tree = worth.torque, worth.tracking, data.documented.tree
    unit, off = f"{tree.unit('N m', 'N')} rms", f"{tree.unit('mrad', 'mm')} rms"
    if torque is not None:
        if torque.size is not None:
            columns.append(("Torque that acted", unit, [number(x) for x in torque.size]))
        if torque.before is not None:
            told = _values(torque.before, torque.before_std)
            columns.append(("Error, documented model", unit, told))
        columns.append(("Error, learned model", unit, _values(torque.after, torque.after_std)))
        if torque.before is not None:
            shares = 100.0 * (torque.after / np.maximum(torque.before, 1e-12) - 1.0)
            changes = [f"{x:+.0f} %".replace("-", "−") if np.isfinite(x) else DASH for x in shares]
            columns.append(("Change", "", changes))
    if tracking is not None and tracking.before is not None:
        columns.append(("Path error, feedback alone", off, _values(1e3 * tracking.before)))
        columns.append(("Path error, with model", off, _values(1e3 * tracking.after)))
    if not columns:
        return None
    return by_column([("Joint", "", list(data.documented.tree.joint_names)), *columns])


def _values(values: Any, std: Any = None) -> list[str]:
    doubts = [None] * len(values) if std is None else std
    return [with_doubt(x, s) for x, s in zip(values, doubts, strict=True)]


def worth_panels(data: RunData, worth: Worth) -> list[Panel]:
    """Errors of every joint before and after, where both are known."""
    panels, torque, tracking = [], worth.torque, worth.tracking
    tree, names = data.documented.tree, data.documented.tree.joint_names
    if torque is not None and torque.before is not None:
        drawing = fall_drawing(torque.before, torque.after, None, names)
        unit = f"{tree.unit('N m', 'N')} rms"
        panels.append(drawing.panel("Torque error by joint", unit, torque.seen))
    if tracking is not None and tracking.before is not None:
        drawing = fall_drawing(1e3 * tracking.before, 1e3 * tracking.after, None, names)
        note = f"feedback alone, and with the feed-forward of the {tracking.seen}"
        panels.append(drawing.panel("Path error by joint", f"{tree.unit('mrad', 'mm')} rms", note))
    return panels
