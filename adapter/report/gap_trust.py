"""Whether to trust what a gap report names, and what to do next, with commands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from adapter.effects.law import LAW
from adapter.gap.phrases import who
from adapter.gap.result import GapResult
from adapter.gap.words import left_above_noise, noise_times, percent, stopped, worse
from adapter.model.numbers import plain
from adapter.model.robots import names as robot_names
from adapter.report.gap_tables import rival_rows, tied
from adapter.report.next_steps import Step, command
from adapter.report.trust import BAD, GOOD, LEFT, LOOK, Check
from adapter.report.words import capital

SURE = 0.99  # evidence from which a finding is called well known
FIGURES = "gap.json"  # beside the page


def gap_checks(result: GapResult) -> list[Check]:
    """All that the result allows; nothing where nothing could be told."""
    if result.problem is not None:
        return []
    checks = [_evidence(result), _rivals(result), _scored(result), _left(result)]
    checks += [Check(BAD, "Contradiction", text) for text in result.contradictions]
    if result.stopped_after_rounds:
        checks.append(Check(LOOK, "The search", stopped(result)))
    return [check for check in checks if check is not None]


def _evidence(result: GapResult) -> Check | None:
    if not result.findings:
        return None
    least = min(result.findings, key=lambda f: f.evidence)
    called = f"{least.title}, {who(least.effect, least.joints)}"
    said = f"the least sure of {len(result.findings)}: {called}, {percent(least.evidence)}"
    return Check(GOOD if least.evidence >= SURE else LOOK, "How sure", said)


def _rivals(result: GapResult) -> Check | None:
    if not result.findings:
        return None
    rows = rival_rows(result)
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
    lost = worse(result)
    said = "errors before and after are of data that the fit never saw"
    said += f"; {lost}" if lost else ""
    return Check(LOOK if lost else GOOD, "On data not fitted", said)


def _left(result: GapResult) -> Check:
    """What the new model leaves, named as unexplained or not."""
    after = noise_times(result)[1]
    joints = sorted({item.joint for item in result.unexplained})
    loud = left_above_noise(result)
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
    asked = _asked(result.what_next)
    figures = FIGURES if folder is None else str(folder / FIGURES)
    steps = [Step(text) for text in asked]
    if asked and result.findings:
        why = "The motion that tells these apart, inside the arm's limits"
        steps.append(Step(why, command("excite", *_robot(result), "--gap", figures)))
    if result.problem is not None and result.model_in:
        why = "Design a motion in which every joint moves enough"
        steps.append(Step(why, command("excite", *_robot(result))))
    laws = [f for f in result.findings if f.effect.startswith(LAW)]
    if laws:
        why = "Keep the law under a name, to look for it in other recordings (--effects)"
        name, joint = f"law_joint_{laws[0].joints[0]}", str(laws[0].joints[0])
        words = ("effects", "keep", figures, "--as", name, "--joint", joint)
        steps.append(Step(why, command(*words)))
    out = result.model_out
    if out is not None:
        why = "See joint by joint what the new model holds otherwise"
        steps.append(Step(why, command("diff", result.model_in or "MODEL", out)))
        why = "Use it in a simulator or planner: the robot's file with what was found"
        steps.append(Step(why, command("export", out, "--urdf", "learned.urdf")))
    return steps


def _asked(texts: Sequence[str]) -> list[str]:
    """Experiments, each motion once with all that it tells: "move so: this stays, that grows"."""
    told: dict[str, dict[str, None]] = {}
    for text in texts:
        motion, _, signs = text.partition(": ")
        told.setdefault(motion, {}).update(dict.fromkeys(filter(None, signs.split(", the "))))
    found = []
    for motion, clauses in told.items():
        signs = ", the ".join(dict.fromkeys(x.removeprefix("the ") for x in clauses))
        found.append(tied(capital(f"{motion}: the {signs}" if signs else motion)))
    return found


def _robot(result: GapResult) -> tuple[str, ...]:
    """The option that names the robot, where it is not the usual one."""
    given = result.model_in
    return ("--robot", given) if given and given != robot_names()[0] else ()
