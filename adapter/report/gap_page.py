"""The gap on one self-contained page: what is missing, how sure that is, what it brings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.law import LAWS
from adapter.gap import words
from adapter.gap.phrases import listed, who
from adapter.gap.result import GapResult, Leftover
from adapter.model.numbers import DASH, plain
from adapter.model.robots import names as robot_names
from adapter.report import gap_tables as tables
from adapter.report.gap_panels import error_panels, signature_panels, unexplained_panels
from adapter.report.html import fill
from adapter.report.next_steps import Step, command
from adapter.report.tables import Tile
from adapter.report.trust import BAD, GOOD, LEFT, LOOK, Check
from adapter.report.words import NARROW, arrow, capital

WORTH = "torque error"  # how the clause begins that says what findings are worth
MOST_NAMED = 3  # recordings, beside the name of the arm
# How clauses begin that are words of ours, no names.
OURS = ("joint", "link", "the ", "something", "from ", "until ", "no ", "a spring", "all joints")


def render_gap_page(result: GapResult, folder: Path | None = None) -> str:
    """The page as HTML text; parts that the result does not have are left out.

    `folder`: where the page and the result's figures are, for commands that take these.
    """
    return fill("gap.html", context(result, folder))


def context(result: GapResult, folder: Path | None = None) -> dict[str, Any]:
    """What the template shows."""
    told = result.problem is None
    shown = _tiles(result) if told else []
    correction, ratio = tables.correction_table(result), tables.correction_ratio(result)
    found = "what was found" if result.findings else ""
    added = filter(None, (found, "the small correction of the inertias" if correction else ""))
    largest = 0.0 if ratio is None or not ratio.size else float(np.abs(ratio).max())
    part = f"The largest part is {largest:.1f} times the deviation that was"
    more = len(result.recordings) - MOST_NAMED
    took = f"{result.wall_s:.1f} s" if result.wall_s > 0.0 else DASH
    return {
        "robot": result.model_name,
        "headline": _headline(result),
        "problem": not told,
        "recordings": [*result.recordings[:MOST_NAMED], *([f"{more} more"] if more > 0 else [])],
        "several": len(result.recordings) > 1,
        "tiles": shown,
        "columns": max(len(shown), 1),
        "findings": [tables.finding_row(same) for same in words.by_kind(result.findings)],
        "matrix": tables.joint_matrix(result),
        "carried": tables.carried_table(result),
        "contradictions": [capital(text) for text in result.contradictions],
        "told": told,
        "error_table": tables.error_table(result) if told else None,
        "after_words": f"with {' and '.join(added) or 'nothing added'}",
        "errors": error_panels(result) if told else [],
        "signatures": signature_panels(result),
        "marked": any(f.interval_s[0] > 0.0 or not f.lasting for f in result.findings),
        "rollouts": bool(result.rollouts),
        "rivals": tables.rival_rows(result),
        "unexplained": [_leftover(item) for item in result.unexplained],
        "unexplained_panels": unexplained_panels(result),
        "unseen": tables.unseen_table(result),
        "correction": correction if told else None,
        "correction_words": "" if ratio is None or not told else f"{part} expected beforehand.",
        "checks": gap_checks(result),
        "steps": gap_steps(result, folder),
        "notes": result.notes,
        "provenance": [
            ("Recordings", ", ".join(result.recordings) or DASH),
            ("Model", result.model_in),
            ("New model", result.model_out or "none was written"),
            ("Time taken", took),
        ],
    }


def _headline(result: GapResult) -> list[str]:
    """Sentences on a page: capital, arrow, no break before a unit."""
    parts = words.headline_parts(result)
    worth = [k for k, part in enumerate(parts) if part.startswith(WORTH)]
    if worth:  # right behind the first finding
        parts.insert(1, parts.pop(worth[0]))
    if result.problem is not None:
        return parts
    said = [capital(text) if text.startswith((*OURS, WORTH, "but ")) else text for text in parts]
    return [f"{tables.tied(text.replace(' -> ', ' → '))}." for text in said]


def _leftover(item: Leftover) -> str:
    begin, end = item.interval_s
    signals = [f"the {words.signal_words(name)} ({name})" for name in item.depends_on]
    times = item.rmse_nm / item.noise_floor_nm if item.noise_floor_nm > 0.0 else np.nan
    size = f", {plain(times, 2)} times its noise," if np.isfinite(times) else ""
    follows = f"that follow {listed(signals) or 'no signal'}"
    said = f"{plain(item.rmse_nm, 2)} N m{size} {follows}, from {begin:.1f} to {end:.1f} s"
    return tables.tied(f"Joint {item.joint}: {said}.")


def _tiles(result: GapResult) -> list[Tile]:
    before, after = result.before, result.after
    noise = np.asarray(result.noise_floor_nm, dtype=float)
    left = len(result.unexplained)
    said = words.left_above_noise(result) or "nothing above the noise left"
    said = f"{left} thing{'' if left == 1 else 's'} unexplained" if left else said
    tiles = [Tile("Effects found", str(len(words.by_kind(result.findings))), said)]
    worst = words.worst_joint(result)
    if worst is not None:
        first, last = before.torque_rmse_nm[worst], after.torque_rmse_nm[worst]
        fell = f"{words.fall(first, last)} {result.unit('N m', worst)}".replace("->", "→")
        fell = fell.replace(" ", NARROW)
        tiles.append(Tile("Torque error", fell, f"joint {worst + 1}, the worst; rms"))
    if worst is not None and noise[worst] > 0.0:
        times = words.noise_times(result)
        fell = arrow(times[0][worst], times[1][worst], "×")
        level = f"noise {plain(noise[worst], 2)} {result.unit('N m', worst)}"
        said = tables.tied(f"joint {worst + 1}, {level}")
        tiles.append(Tile("In units of its noise", fell, said))
    off, off_after = before.rollout_rmse_rad, after.rollout_rmse_rad
    if off is not None and np.isfinite(off).any():
        j = int(np.nanargmax(off))
        still = np.nan if off_after is None else off_after[j]
        value = arrow(1e3 * off[j], 1e3 * still, result.unit("mrad", j))
        note = tables.tied(f"joint {j + 1}, rms within 0.5 s")
        tiles.append(Tile("Forward simulation off by", value, note))
    return tiles


# --- whether to trust what is named, and what to do next -----------------------------------------

FIGURES = "gap.json"  # beside the page


def gap_checks(result: GapResult) -> list[Check]:
    """All that the result allows; nothing where nothing could be told."""
    if result.problem is not None:
        return []
    checks = [_evidence(result), _rivals(result)] if result.findings else []
    checks += [_scored(result), _left(result)]
    checks += [Check(BAD, "Contradiction", text) for text in result.contradictions]
    if result.stopped_after_rounds:
        checks.append(Check(LOOK, "The search", words.stopped(result)))
    return checks


def _evidence(result: GapResult) -> Check:
    least = min(result.findings, key=lambda f: f.evidence)
    called = f"{least.title}, {who(least.effect, least.joints)}"
    said = f"the least sure of {len(result.findings)}: {called}, {words.percent(least.evidence)}"
    return Check(GOOD if least.evidence >= words.SURE else LOOK, "How sure", said)


def _rivals(result: GapResult) -> Check:
    rows = tables.rival_rows(result)
    if not rows:
        said = "no other effect of the catalogue explains 90 % of any of these on these data"
        return Check(GOOD, "What else explains it", said)
    said = "; ".join(f"{found}: {other} of it" for found, other, _ in rows)
    return Check(LOOK, "What else explains it", said)


def _scored(result: GapResult) -> Check:
    """On which data errors before and after are told, and whether a joint got worse."""
    if result.in_sample:
        said = "in sample only: nothing could be held out, so that errors after may be too small"
        return Check(LOOK, "On data not fitted", said)
    lost, said = words.worse(result), "errors before and after are of data that the fit never saw"
    said += f"; {lost}" if lost else ""
    return Check(LOOK if lost else GOOD, "On data not fitted", said)


def _left(result: GapResult) -> Check:
    """What the new model leaves, named as unexplained or not."""
    after = words.noise_times(result)[1]
    joints = sorted({item.joint for item in result.unexplained})
    loud = words.left_above_noise(result)
    if joints:
        where = f"joint{'s' if len(joints) > 1 else ''} {', '.join(map(str, joints))}"
        said = f"something that no effect explains on {where}{'; ' + loud if loud else ''}"
        return Check(LOOK, LEFT, said)
    if loud:
        return Check(LOOK, LEFT, f"{loud}, and nothing of the catalogue names it")
    most = plain(float(np.nanmax(after)), 2) if np.isfinite(after).any() else "an unknown number of"
    return Check(GOOD, LEFT, f"at most {most} times the noise, on every joint")


def gap_steps(result: GapResult, folder: Path | None) -> list[Step]:
    """What to measure next, and what the new model is for."""
    # Experiments, each motion once with all that it tells: "move so: this stays, that grows"
    told: dict[str, dict[str, None]] = {}
    for text in result.what_next:
        motion, _, signs = text.partition(": ")
        told.setdefault(motion, {}).update(dict.fromkeys(filter(None, signs.split(", the "))))
    asked = []
    for motion, clauses in told.items():
        signs = ", the ".join(dict.fromkeys(x.removeprefix("the ") for x in clauses))
        asked.append(tables.tied(capital(f"{motion}: the {signs}" if signs else motion)))
    figures = FIGURES if folder is None else str(folder / FIGURES)
    steps = [Step(text) for text in asked]
    if asked and result.findings:
        why = "The motion that tells these apart, inside the arm's limits"
        steps.append(Step(why, command("excite", *_robot(result), "--gap", figures)))
    if result.problem is not None and result.model_in:
        why = "Design a motion in which every joint moves enough"
        steps.append(Step(why, command("excite", *_robot(result))))
    laws = [f for f in result.findings if f.effect in LAWS]
    if laws:
        why = "Keep the law under a name, to look for it in other recordings (--effects)"
        name, joint = f"law_joint_{laws[0].joints[0]}", str(laws[0].joints[0])
        keep = command("effects", "keep", figures, "--as", name, "--joint", joint)
        steps.append(Step(why, keep))
    out = result.model_out
    if out is not None:
        why = "See joint by joint what the new model holds otherwise"
        steps.append(Step(why, command("diff", result.model_in or "MODEL", out)))
        why = "Use it in a simulator or planner: the robot's file with what was found"
        steps.append(Step(why, command("export", out, "--urdf", "learned.urdf")))
    return steps


def _robot(result: GapResult) -> tuple[str, ...]:
    """The option that names the robot, where it is not the usual one."""
    given = result.model_in
    return ("--robot", given) if given and given != robot_names()[0] else ()
