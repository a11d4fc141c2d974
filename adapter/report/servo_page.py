"""What was found of a position-controlled arm's servos, on one self-contained page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from adapter.gap import servo_words
from adapter.gap.phrases import shown_unit, who
from adapter.gap.servo_arms import ServoNumber
from adapter.gap.servo_result import EFFECTS, ServoGap
from adapter.model.numbers import DASH, plain, plus_minus
from adapter.report.gap_panels import fall_drawing, rollout_drawing, worst_window
from adapter.report.gap_tables import tied
from adapter.report.html import fill
from adapter.report.next_steps import Step, command
from adapter.report.style import Panel
from adapter.report.tables import Table, Tile, by_column
from adapter.report.trust import GOOD, LOOK, Check
from adapter.report.words import arrow, capital

SHARE, CLOSE_MRAD = 0.25, 4.0  # of the error before; or so small: the joint is explained


def render_servo_page(
    gap: ServoGap, model: str, servos: Path, beside: Sequence[ServoNumber] = ()
) -> str:
    """The page as HTML text.

    Args:
        model: as the command had it; servos: the file they are in.
        beside: numbers of this arm and of others of its kind.
    """
    tiles, joints = _tiles(gap), [f"joint {j + 1}" for j in range(len(gap.joint_names))]
    listed = tuple(title for title, _, _ in EFFECTS.values())  # in the table, not the headline
    parts = [x for x in servo_words.headline(gap).split("; ") if not x.startswith(listed)]
    parts.sort(key=lambda text: not text.startswith("tracking error"))
    panels = []
    for what, factor, unit, (before, after) in (
        ("Tracking error", 1e3, f"{gap.unit('mrad')} rms", (gap.before, gap.after)),
        ("At the hand", 1e3, "mm rms", (gap.hand_before[:-1], gap.hand_after[:-1])),
    ):
        drawing = fall_drawing(factor * before, factor * after, None, joints)
        note = f"of {gap.hand}, by each joint's error alone" if unit == "mm rms" else ""
        panels.append(drawing.panel(f"{what} by joint", unit, note))
    return fill(
        "servo.html",
        {
            "robot": gap.model_name,
            "headline": [f"{tied(capital(x.replace(' -> ', ' → ')))}." for x in parts],
            "recordings": list(dict.fromkeys(name for name, _ in gap.curves)),
            "scored": gap.scored,
            "tiles": tiles,
            "columns": len(tiles),
            "found": _found(gap),
            "open": list(dict.fromkeys(f.open for f in gap.findings if f.open)),
            "ground": capital(servo_words.grounded(gap)) if gap.ground.root > 0.0 else "",
            "errors": panels,
            "error_table": _errors(gap),
            "moments": _moments(gap),
            "odd": [text for number in beside for text in number.sentences()],
            "arms": _arms(beside),
            "checks": _checks(gap),
            "steps": _steps(gap, model, servos),
            "notes": gap.notes,
            "provenance": [
                ("Recordings", ", ".join(gap.recordings)),
                ("Model", model),
                ("Servos", str(servos)),
            ],
        },
    )


def _tiles(gap: ServoGap) -> list[Tile]:
    j = int(np.argmax(gap.before))
    off = arrow(1e3 * gap.before[j], 1e3 * gap.after[j], gap.unit("mrad", j))
    at_hand = arrow(1e3 * gap.hand_before[-1], 1e3 * gap.hand_after[-1], "mm")
    numbers = str(sum(len(f.joints) for f in gap.findings if f.effect != "servo_delay"))
    late = [f for f in gap.findings if f.effect == "servo_delay"]
    told = f"commands act {1e3 * late[0].values[0]:.2f} ms late" if late else "no delay of commands"
    tracking = Tile("Tracking error", off, f"joint {j + 1}, rms")
    return [Tile("Numbers found", numbers, told), tracking, Tile("At the hand", at_hand, gap.hand)]


def _found(gap: ServoGap) -> Table | None:
    """Findings, a row for each joint and a column for each effect."""
    columns = [("Joint", "", [f"{j} {name}" for j, name in enumerate(gap.joint_names, start=1)])]
    for finding in gap.findings:
        title = EFFECTS[finding.effect][0]
        factor, shown = shown_unit(finding.values[0], finding.unit)
        cells = [DASH] * len(gap.joint_names)
        rows = zip(finding.values, finding.std, finding.documented, strict=True)
        for j, (value, std, documented) in zip(finding.joints, rows, strict=True):
            known = "" if documented is None else f", not {plain(factor * documented, 3)}"
            cells[j - 1] = tied(f"{plus_minus(factor * value, factor * std)}{known}")
        columns.append((capital(title), shown, cells))
    return by_column(columns) if len(columns) > 1 else None


def _errors(gap: ServoGap) -> Table:
    hand = gap.hand_before, gap.hand_after
    off = 1e3 * np.stack([gap.before, gap.after, *(x[:-1] for x in hand)], axis=1)
    cells = ((plain(x, 3) for x in row) for row in off.tolist())
    rows = [[name, *row] for name, row in zip(gap.joint_names, cells, strict=True)]
    rows.append(["all", DASH, DASH, *(plain(1e3 * x[-1], 3) for x in hand)])
    heads = ["Joint", "Before", "After", "Before", "After"]
    return Table(heads, rows, ["", *[gap.unit("mrad")] * 2, "hand, mm", "hand, mm"])


def _arms(numbers: Sequence[ServoNumber]) -> Table | None:
    """A row for each number, a column for each arm; those that differ stand out."""
    arms = list(dict.fromkeys(arm for number in numbers for arm in number.values))
    told = ((x, [tied(x.cell(arm)) + " ◄" * (arm in x.odd) for arm in arms]) for x in numbers)
    rows = [[capital(x.title), *cells] for x, cells in told]
    return Table(["Number", *arms], rows) if rows else None


def _moments(gap: ServoGap) -> list[Panel]:
    """The seconds in which the new servos are most off, of the joints that are most off."""
    panels = []
    for j in np.argsort(-gap.after)[:6].tolist():
        each = []
        for name, x in gap.curves:
            start, stop = worst_window(x.t, left := x.after[:, j] - x.measured[:, j])
            inside = (x.t >= start) & (x.t <= stop)
            each.append((float(np.sum(left[inside] ** 2)), name, x, (start, stop)))
        _, name, x, span = max(each, key=lambda one: one[0])
        title = f"Joint {j + 1}, {gap.joint_names[j]}"
        panels.append(rollout_drawing(x, j, *span).panel(title, gap.unit("rad", j), f"of {name}"))
    return panels


def _unexplained(gap: ServoGap) -> list[int]:
    """Joints (from 0) of which too much is left."""
    far = (gap.after > SHARE * gap.before) & (1e3 * gap.after > CLOSE_MRAD)
    return [int(j) for j in np.flatnonzero(far)]


def _checks(gap: ServoGap) -> list[Check]:
    said = f"errors are of motions that the fit never saw ({gap.scored})"
    lost = f"; {who('', gap.worse)}: not better" if gap.worse else ""
    checks = [Check(LOOK if gap.worse else GOOD, "On data not fitted", said + lost)]
    left = [j + 1 for j in _unexplained(gap)]
    close = f"{CLOSE_MRAD:g} {gap.unit('mrad')}"
    said = f"every joint is below a quarter of its error or below {close}"
    if left:
        said = f"{who('', left)}: more than a quarter of the error and {close}"
        said += " that no number of these servos explains"
    checks.append(Check(LOOK if left else GOOD, "What is left", said))
    if gap.scale_open:
        said = (
            f"{who('', gap.scale_open)}: the documented masses hardly load it: motion is "
            "foretold, but gains, friction and inertia are known but for a common factor"
        )
        checks.append(Check(LOOK, "Scale", said))
    return checks


def _steps(gap: ServoGap, model: str, servos: Path) -> list[Step]:
    """What to measure next, and what the servos are for."""
    steps = []
    if "held out" not in gap.scored:
        why = "Record another motion, best the one that counts, and let it judge"
        steps.append(Step(why, command("gap", *gap.recordings, "--hold-out", "ANOTHER")))
    if gap.ground.root > gap.servos.ground.root == 0.0:
        steps.append(Step("Record a second motion that touches the table, or none that does"))
    left = _unexplained(gap)
    slow = [j + 1 for j in left if _share_slow(gap, j) > 0.5]
    fast = [j + 1 for j in left if j + 1 not in slow]
    rest = "what is left is where it is"
    for joints, why in (
        (slow, f"{rest} slow: record slow ramps up and down, with stops"),
        (fast, f"{rest} fast: record steps and quick motions of several sizes"),
        (gap.scale_open, "move it with a known mass in the hand that the model has too"),
    ):
        if joints:
            steps.append(Step(f"{capital(who('', joints))}: {why}"))
    if not gap.servos.is_ideal:
        why = "Use it: an arm for MuJoCo that follows commands as this one does"
        own = "--servo", str(servos)
        steps.append(Step(why, command("export", model, *own, "--mjcf", "arm.xml")))
        why = "See later what wears: only what has changed is named"
        steps.append(Step(why, command("gap", "LATER.mcap", "--robot", model, *own)))
    return steps


def _share_slow(gap: ServoGap, j: int) -> float:
    """Of the squares that are left of a joint, the share at slow motion."""
    slow, whole = 0.0, 0.0
    for _, x in gap.curves:
        squares = (x.after[:, j] - x.measured[:, j]) ** 2
        still = np.abs(np.gradient(x.after[:, j], x.t)) < 0.1  # rad/s
        slow, whole = slow + float(squares[still].sum()), whole + float(squares.sum())
    return slow / max(whole, 1e-30)
