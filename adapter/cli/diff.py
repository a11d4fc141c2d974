"""`adapter diff`: two models of one arm, joint by joint, as tables in words and for JSON."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from rich.table import Table

from adapter.cli.common import robot_of
from adapter.runs import compare
from adapter.runs.compare import BODY, FRAME, GRAVITY, NOTHING, SIGNIFICANT, Change, ModelDifference
from adapter.runs.terminal import console, json_ready, output, write_json


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out: from the documentation to the model, or from A to B."""
    first = robot_of(args, args.first)
    if args.second is None:
        first, second = compare.documentation_of(first), first
    else:
        second = robot_of(args, args.second)
    found = compare.compare(first, second)
    if args.second is not None and len(set(found.names)) == 1:  # two runs of one arm
        found = replace(found, names=(args.first, args.second))
    write_json(args.json, difference_json(found))
    shown = console if str(args.json) == "-" else output
    for line in difference_summary(found):
        shown.print(line, soft_wrap=True)
    frames = "joint", "its frame in the one before", "the link behind it"
    effects = "effect", "from A to B, joint by joint", "z", "N m"
    for heads, rows in ((frames, difference_matrix(found)), (effects, effect_rows(found))):
        table = Table(*heads, box=None, pad_edge=False, title_justify="left", padding=(0, 2, 0, 0))
        for row in rows:
            table.add_row(*row)  # cells hold lines of their own
        if rows:
            shown.print(table)
    if found.changes:
        said = "z: standard deviations; N m, mm: what it alone does to torque and to the hand, rms"
        shown.print(said, soft_wrap=True)
    return 0


def difference_matrix(found: ModelDifference) -> list[tuple[str, ...]]:
    """A row for each joint, in order: what differs of its frame and of its link; none where nothing
    of these is listed."""
    cells = {(change.joint, change.what): _cell(change) for change in found.changes}
    rows: list[tuple[str, ...]] = [
        (joint, *(cells.get((joint, k), "") for k in (FRAME, BODY))) for joint in found.joints
    ]
    return [row for row in rows if any(row[1:])]


def _cell(change: Change) -> str:
    """What differs, and below it how sure and how much that is."""
    if not _listed(change):
        return ""
    sure = [] if change.z is None else [f"z {change.z:.1f}"]
    moved = [f"hand {1e3 * change.hand_m:.2g} mm"] if change.hand_m > NOTHING else []
    torque = f"{change.torque_nm:.2g} N m on {change.torque_joint}"
    sizes = [*sure, *moved, *([torque] if change.torque_nm > NOTHING else [])]
    return f"{_change_words(change)}\n({', '.join(sizes)})"


def effect_rows(found: ModelDifference) -> list[tuple[str, ...]]:
    """A row for each effect with all its joints; what is of no joint too."""
    groups: dict[str, list[Change]] = {}
    for change in found.changes:
        if change.what not in (FRAME, BODY) and _listed(change):
            groups.setdefault(change.what, []).append(change)
    order = {joint: k for k, joint in enumerate(found.joints)}
    rows: list[tuple[str, ...]] = []
    for what, changes in groups.items():
        changes.sort(key=lambda change: order.get(change.joint, -1))
        said = "\n".join(f"{c.joint + ': ' if c.joint else ''}{_change_words(c)}" for c in changes)
        z = _from_to([c.z for c in changes if c.z is not None])
        rows.append((what, said, z, _from_to([c.torque_nm for c in changes])))
    return rows


def _from_to(values: list[float]) -> str:
    """Smallest to largest."""
    if not values:
        return "-"
    low, high = (f"{x:.0f}" if x >= 10.0 else f"{x:.2g}" for x in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def difference_summary(found: ModelDifference) -> list[str]:
    """What all of it does, and what is not listed."""
    if not found.changes:
        return [f"{found.names[0]} and {found.names[1]} are the same"]
    pairs = zip(found.joints, found.torque_nm, found.torque_size_nm, strict=True)
    torques = ", ".join(f"{x:.2g} of {size:.2g} on {joint}" for joint, x, size in pairs)
    rms, most = 1e3 * found.hand_rms_m, 1e3 * found.hand_max_m
    away = f"elsewhere by {rms:.2g} mm rms, {most:.2g} mm at most"
    stands = f"{found.hand} stands {away if found.hand_max_m > NOTHING else 'where it stood'}"
    lines = [f"all together: torque changes by {torques} (N m, rms over a motion); {stands}"]
    left = [change for change in found.changes if not _listed(change)]
    if len(left) == len(found.changes):
        lines.insert(0, f"{found.names[0]} and {found.names[1]} agree, as far as they are known")
    noise = [change for change in left if not change.significant]
    owners = [(c, c.link if c.what == BODY else c.joint) for c in left if c.significant]
    idle = ", ".join(f"{owner} {c.what}".strip() for c, owner in owners)
    parts = []
    if noise:
        kinds = Counter(change.what for change in noise)
        counts = ", ".join(f"{kind} {count}" for kind, count in kinds.items())
        parts = [f"{len(noise)} by less than {SIGNIFICANT:g} standard deviations ({counts})"]
    parts += [f"without any torque, and the hand stays: {idle}"] if idle else []
    return [*lines, f"not listed: {'; '.join(parts)}"] if parts else lines


def _listed(change: Change) -> bool:
    return change.significant and change.matters


def _change_words(change: Change) -> str:
    values = change.values
    if change.what == FRAME:
        turn, shift = np.degrees(values["turn_rad"][1]), 1e3 * values["shift_m"][1]
        words = f"turned by {turn:.3g}°, moved by {shift:.3g} mm"
    elif change.what == BODY:
        (a, b), centres = values["mass_kg"], values["com_m"]
        way = 1e3 * float(np.linalg.norm(centres[1] - centres[0]))
        sizes = [float(np.trace(tensor)) / 3.0 for tensor in values["inertia_kg_m2"]]
        words = f"{a:.4g} -> {b:.4g} kg, centre moved by {way:.3g} mm, mean inertia "
        words += f"{sizes[0]:.3g} -> {sizes[1]:.3g} kg m²"
    else:
        named = {key: "" if key == GRAVITY else f"{key} " for key in values}
        told = {key: " -> ".join(map(_number, pair)) for key, pair in values.items()}
        words = ", ".join(f"{named[key]}{told[key]} {change.units[key]}" for key in values)
    if change.shown >= 0.5:  # mostly: nothing is to be told
        return words
    share = f"{100.0 * change.shown:.2g} % of it" if change.shown else "none of it"
    return f"{words} (data can show {share})"


def _number(value: Any) -> str:
    """A number, or some."""
    return "none" if value is None else " ".join(f"{x:.3g}" for x in np.ravel(value))


def difference_json(found: ModelDifference) -> dict[str, Any]:
    """Everything, ready for JSON."""
    changes = [{**asdict(change), "listed": _listed(change)} for change in found.changes]
    told = {**asdict(found), "changes": changes, "summary": difference_summary(found)}
    told["models"] = told.pop("names")
    return dict(json_ready(told))
