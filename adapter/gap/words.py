"""What was found, in sentences: numbers are rounded by their standard deviation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.markup import escape

from adapter.effects.catalogue import CATALOGUE
from adapter.gap.phrases import listed, numbered, phrase, phrase_of, plain, shown_unit, who
from adapter.gap.result import Finding, GapResult, Leftover
from adapter.model.spatial import Array

MOST_PARTS = 3  # of a headline; the page's table has the rest
ABOVE_NOISE = 1.5  # torque error over the noise from which "down to its noise" is not true
NOT_EXPLAINED = "are not explained by any effect of the catalogue"
SIGNALS = {
    "dq": "velocity",
    "ddq": "acceleration",
    "q": "position",
    "tau": "load",
    "t": "time",
}


def headline(result: GapResult) -> str:
    """The outcome in one sentence."""
    if result.problem is not None:
        return result.problem
    if not result.findings and not result.unexplained:
        return "; ".join(filter(None, (_nothing(result), stopped(result))))
    parts = _finding_parts(result.findings)
    if result.findings:
        parts.append(_shrink(result))
    parts += [_left(result.unexplained), stopped(result)]
    return "; ".join(part for part in parts if part)


def stopped(result: GapResult) -> str:
    """That the search did not come to its end; empty where it did."""
    rounds = result.stopped_after_rounds
    return f"the search stopped after {rounds} rounds, there may be more" if rounds else ""


def as_json(result: GapResult) -> dict[str, Any]:
    """What the JSON file holds: the outcome in a sentence, and all figures."""
    return {"headline": headline(result), **result.as_dict()}


def sentence(finding: Finding) -> str:
    """One finding: when, where, what, how much."""
    when = span(finding)
    return f"{when} {phrase(finding)}" if when else phrase(finding)


def span(finding: Finding) -> str:
    """When it acts; empty where it does throughout."""
    begin, end = finding.interval_s
    late, ends = begin > 0.0, not finding.lasting
    if late and ends:
        return f"from {_instant(begin)} to {_instant(end)} s"
    if late:
        return f"from {_instant(begin)} s on"
    return f"until {_instant(end)} s" if ends else ""


def leftover_sentence(leftover: Leftover) -> str:
    """What stays unexplained on one joint, and what it follows."""
    return f"joint {leftover.joint}: {plain(leftover.rmse_nm, 2)} N m {_follows(leftover)}"


def rivals(finding: Finding) -> str:
    """What else it could be and how to tell; empty where nothing else comes close."""
    if not finding.overlaps:
        return ""
    parts = [
        f"{title_of(name)}, which explains {'all' if share >= 1.0 else percent(share)} of it here"
        for name, share in finding.overlaps.items()
    ]
    return f"could also be {', or '.join(parts)}; to split: {finding.split_by}"


def title_of(effect: str) -> str:
    """Name of an effect for people."""
    return CATALOGUE[effect].title if effect in CATALOGUE else effect.replace("_", " ")


def percent(share: float) -> str:
    """A share in percent; what is not all of it is never said to be.

    >>> percent(0.9704), percent(0.99951), percent(1.0)
    ('97 %', 'more than 99.9 %', '100 %')
    """
    if not math.isfinite(share):
        return "an unknown share"
    if 0.999 < share < 1.0:
        return "more than 99.9 %"
    return f"{100.0 * share:.3g} %" if share > 0.99 else f"{100.0 * share:.2g} %"


def signal_words(name: str) -> str:
    """A signal for people: "dq3" is "velocity of joint 3"."""
    kind = name.rstrip("0123456789")
    joint = name[len(kind) :]
    meaning = SIGNALS.get(kind, kind)
    return f"{meaning} of joint {joint}" if joint else meaning


def data_words(result: GapResult) -> str:
    """What the recordings are called in a sentence."""
    return "this recording" if len(result.recordings) <= 1 else "these recordings"


def _nothing(result: GapResult) -> str:
    said = "the model explains " + data_words(result)
    noise = np.where(result.noise_floor_nm > 0.0, result.noise_floor_nm, np.nan)
    before = _largest(result.before.torque_rmse_nm / noise)
    after = _largest(result.after.torque_rmse_nm / noise)
    if after > ABOVE_NOISE:
        return (
            f"no effect of the catalogue is called for; the model explains {data_words(result)} "
            f"to within {after:.2g} times the noise on every joint"
        )
    if before > ABOVE_NOISE:
        return f"{said} down to its noise once its inertias are corrected by what its prior allows"
    return f"{said} down to its noise"


def _largest(ratio: np.ndarray) -> float:
    known = ratio[np.isfinite(ratio)]
    return float(known.max()) if known.size else 0.0


def _finding_parts(findings: Sequence[Finding]) -> list[str]:
    """Findings in words, those of the same kind in one; the largest first where there are many."""
    by_kind: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        by_kind.setdefault((finding.effect, span(finding)), []).append(finding)
    groups = list(by_kind.values())
    if len(groups) > MOST_PARTS:
        groups.sort(key=lambda group: -max(_size(f) for f in group))
    parts = [_group(group) for group in groups[:MOST_PARTS]]
    more = sum(len(group) for group in groups[MOST_PARTS:])
    return [*parts, f"{more} more finding{'' if more == 1 else 's'}"] if more else parts


def _size(finding: Finding) -> float:
    worth = np.asarray(finding.torque_rms_nm, dtype=float)
    return float(np.nansum(worth)) if worth.size else 0.0


def _group(findings: Sequence[Finding]) -> str:
    if len(findings) == 1:
        return sentence(findings[0])
    first = findings[0]
    ordered = sorted(findings, key=lambda f: f.joints)
    joints = [j for f in ordered for j in f.joints]
    verb = phrase_of(first).verb
    said = f"{who(first.effect, joints)} {verb} {first.title}{_values(ordered)}"
    return f"{span(first)} {said}" if span(first) else said


def _values(findings: Sequence[Finding]) -> str:
    """Main parameters of findings of one kind, in brackets."""
    key = phrase_of(findings[0]).key
    values = [float(f.parameters[key]) for f in findings if f.parameters.get(key) is not None]
    if len(values) < len(findings):
        return ""
    factor, unit = shown_unit(max(values, key=abs), findings[0].units.get(key, ""))
    return f" ({listed([plain(factor * value, 2) for value in values])} {unit})"


def _shrink(result: GapResult) -> str:
    """Torque error before and after, of the joint that is meant or that gains most."""
    before, after = result.before.torque_rmse_nm, result.after.torque_rmse_nm
    gain = np.asarray(before) - np.asarray(after)
    if not np.isfinite(gain).any():
        return ""
    best = int(np.nanargmax(gain))
    meant = {j for finding in result.findings for j in finding.joints}
    of = "" if meant == {best + 1} else f" of joint {best + 1}"
    return f"torque error{of} {fall(before[best], after[best])} N m"


def fall(before: float, after: float) -> str:
    """What an error was and what it has become.

    >>> fall(1.924, 0.0213), fall(0.05, 0.002)
    ('1.92 -> 0.02', '0.050 -> 0.002')
    """
    digits = 2 if after >= 0.01 else 3
    return f"{before:.{digits}f} -> {after:.{digits}f}"


def _left(unexplained: Sequence[Leftover]) -> str:
    """Unexplained residuals in one clause; of each joint the largest."""
    worst: dict[int, Leftover] = {}
    for item in sorted(unexplained, key=lambda item: item.rmse_nm):
        worst[item.joint] = item
    if len(worst) <= 1:
        return "".join(leftover_sentence(item) for item in worst.values())
    joints = sorted(worst)
    sizes = listed([plain(worst[j].rmse_nm, 2) for j in joints])
    return f"joints {numbered(joints)}: {sizes} N m {NOT_EXPLAINED}"


def _follows(leftover: Leftover) -> str:
    followed = listed(list(leftover.depends_on)) or "no signal"
    return f"that follow {followed} {NOT_EXPLAINED}"


def _instant(t: float) -> str:
    return f"{t:.2f}".rstrip("0").rstrip(".")


LABEL = 26  # characters


def console_summary(result: GapResult) -> list[str]:
    """Headline, findings, figures by joint, what to do next; for `rich.console.Console.print`."""
    color = "red" if result.problem is not None else "bold"
    lines = [f"[{color}]{escape(headline(result))}[/{color}]"]
    for finding in result.findings:
        lines += _finding(finding)
    lines += [f"[yellow]?[/yellow] {escape(leftover_sentence(x))}" for x in result.unexplained]
    lines += _figures(result)
    lines += [f"[cyan]next[/cyan] {escape(text)}" for text in result.what_next]
    lines += [f"[dim]note[/dim] {escape(text)}" for text in result.notes]
    if result.model_out is not None:
        lines.append(f"model {escape(result.model_out)}")
    return lines


def _finding(finding: Finding) -> list[str]:
    sure = f"evidence {percent(finding.evidence)}, z {plain(finding.detectability, 2)}"
    lines = [f"[green]•[/green] {escape(sentence(finding))} [dim]({sure})[/dim]"]
    other = rivals(finding)
    return [*lines, f"  [dim]{escape(other)}[/dim]"] if other else lines


def _figures(result: GapResult) -> list[str]:
    """One line per figure, joints in order; none where nothing is known."""
    before, after = result.before, result.after
    rows: list[tuple[str, Array | None, float]] = [
        ("torque noise, N m", result.noise_floor_nm, 1.0),
        ("torque error before, N m", before.torque_rmse_nm, 1.0),
        ("             after, N m", after.torque_rmse_nm, 1.0),
        (f"{result.simulator or 'rollout'} off by, before, mrad", before.rollout_rmse_rad, 1e3),
        ("       after, mrad", after.rollout_rmse_rad, 1e3),
    ]
    return [
        f"{name:<{LABEL}} " + " ".join(f"{plain(factor * x, 3):>7}" for x in values)
        for name, values, factor in rows
        if values is not None and np.isfinite(values).any()
    ]
