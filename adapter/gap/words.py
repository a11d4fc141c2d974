"""What was found, in sentences: numbers are rounded by their standard deviation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.markup import escape

from adapter.effects.by_joint import SMOOTHING_DQ
from adapter.effects.catalogue import KNOWN
from adapter.gap.phrases import (
    listed,
    numbered,
    parameter_lines,
    phrase,
    phrase_of,
    shown_unit,
    who,
)
from adapter.gap.result import WORSE, Finding, GapResult, Leftover, LogLoad
from adapter.model.numbers import plain, plus_minus
from adapter.model.spatial import Array

SURE = 0.99  # evidence from which a finding is called well known
MOST_PARTS = 3  # of a headline; the page's table has the rest
ABOVE_NOISE = 1.5  # torque error over the noise from which "down to its noise" is not true
WIDER = "move the joint faster, and over a wider range"  # what tells one curve from another
NOT_EXPLAINED = "are not explained by any effect of the catalogue"
SIGNALS = {"dq": "velocity", "ddq": "acceleration", "q": "position", "tau": "load", "t": "time"}


def headline(result: GapResult) -> str:
    """The outcome in one sentence."""
    return "; ".join(headline_parts(result))


def headline_parts(result: GapResult) -> list[str]:
    """The outcome in clauses: what was found, what it is worth, what is left."""
    if result.problem is not None:
        return [result.problem]
    if not result.findings and not result.unexplained:
        said = [_nothing(result), *result.contradictions, stopped(result)]
        return [part for part in said if part]
    parts = finding_parts(result.findings)
    if result.findings:
        parts += [_shrink(result), worse(result)]
    parts += [_left(result), *result.contradictions, stopped(result)]
    return [part for part in parts if part]


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
    """In which of several recordings it acts, and when; empty where it does throughout all."""
    begin, end = finding.interval_s
    late, ends = begin > 0.0, not finding.lasting
    when = f"until {_instant(end)} s" if ends else ""
    if late:
        when = f"from {_instant(begin)} " + (f"to {_instant(end)} s" if ends else "s on")
    where = f"in {finding.recording}" if finding.recording else ""
    return " ".join(filter(None, (where, when)))


def leftover_sentence(leftover: Leftover, result: GapResult | None = None) -> str:
    """What stays unexplained on one joint, and what it follows."""
    followed, size = listed(list(leftover.depends_on)) or "no signal", plain(leftover.rmse_nm, 2)
    unit = result.unit("N m", leftover.joint - 1) if result is not None else "N m"
    return f"joint {leftover.joint}: {size} {unit} that follow {followed} {NOT_EXPLAINED}"


def rivals(findings: Sequence[Finding]) -> str:
    """What else findings of one kind could be, and how to tell; empty where nothing comes close."""
    shares = shares_of(findings)
    if not shares:
        return ""
    parts = [f"{title_of(name)}, which explains {share} of it here" for name, share in shares]
    return f"could also be {', or '.join(parts)}; to split: {findings[0].split_by or WIDER}"


def shares_of(findings: Sequence[Finding]) -> list[tuple[str, str]]:
    """Rivals of findings of one kind, and how much of these they explain: "91 to 97 %"."""
    out = []
    for name in findings[0].overlaps:
        if name == "link_inertia" and findings[0].two_readings:
            continue
        low, high = (pick(f.overlaps[name] for f in findings) for pick in (min, max))
        most = "all" if high >= 1.0 else percent(high)
        least = "all" if low >= 1.0 else percent(low)
        out.append((name, most if most == least else f"{least.removesuffix(' %')} to {most}"))
    return out


def alike(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Findings with the same rivals and the same way to tell, together; in order."""
    groups: dict[tuple[object, ...], list[Finding]] = {}
    for f in findings:
        groups.setdefault((f.effect, tuple(f.overlaps), f.split_by, span(f)), []).append(f)
    return list(groups.values())


def title_of(effect: str) -> str:
    """Name of an effect for people."""
    return KNOWN[effect].title if effect in KNOWN else effect.replace("_", " ")


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


def noise_times(result: GapResult) -> tuple[np.ndarray, np.ndarray]:
    """(n,) torque errors before and after in units of the noise; NaN where that is not known.

    In the band that the noise is of, and of a joint that slides: what it holds at a rest is what
    static friction lets it.
    """
    noise = np.where(result.noise_floor_nm > 0.0, result.noise_floor_nm, np.nan)
    if not result.curves:
        return result.before.torque_rmse_nm / noise, result.after.torque_rmse_nm / noise
    dq, before, after = (
        np.concatenate([getattr(x, key) for x in result.curves])
        for key in ("dq", "before", "after")
    )
    slides = np.abs(dq) > SMOOTHING_DQ
    rows = np.where(slides.any(axis=0), slides, True)
    sizes = (np.sqrt(np.sum(rows * x**2, axis=0) / rows.sum(axis=0)) for x in (before, after))
    return tuple(size / noise for size in sizes)


def left_above_noise(result: GapResult) -> str:
    """What the new model leaves above the noise, though nothing names it; empty where nothing."""
    times = np.nan_to_num(noise_times(result)[1])
    loud = [int(j) + 1 for j in np.flatnonzero(times > ABOVE_NOISE)]
    if not loud:
        return ""
    most = plain(float(times.max()), 2)
    if len(loud) == 1:
        return f"{most} times the noise stays on joint {loud[0]}"
    return f"up to {most} times the noise stays on joints {numbered(loud)}"


def _nothing(result: GapResult) -> str:
    said = "the model explains " + data_words(result)
    known = (times[np.isfinite(times)] for times in noise_times(result))
    before, after = (float(times.max(initial=0.0)) for times in known)
    if after > ABOVE_NOISE:
        return (
            f"no effect of the catalogue is called for; the model explains {data_words(result)} "
            f"to within {after:.2g} times the noise on every joint"
        )
    if before > ABOVE_NOISE:
        return f"{said} down to its noise once its inertias are corrected by what its prior allows"
    return f"{said} down to its noise"


def finding_parts(findings: Sequence[Finding]) -> list[str]:
    """Findings in words, those of the same kind in one; the surest first, of many the largest."""
    groups = by_kind(findings)
    if len(groups) > MOST_PARTS:
        groups.sort(key=lambda group: -max(_size(f) for f in group))
    groups.sort(key=lambda group: min(f.evidence for f in group) < SURE)
    parts = [_group(group) for group in groups[:MOST_PARTS]]
    more = sum(len(group) for group in groups[MOST_PARTS:])
    return [*parts, f"{more} more finding{'' if more == 1 else 's'}"] if more else parts


def by_kind(findings: Sequence[Finding]) -> list[list[Finding]]:
    """Findings of one effect that act at the same time, together; in order of the first."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        each = bool(finding.recording) and finding.throughout
        key = (finding.effect, "in each" if each else span(finding))
        groups.setdefault(key, []).append(finding)
    return list(groups.values())


def _size(finding: Finding) -> float:
    worth = np.asarray(finding.torque_rms_nm, dtype=float)
    return float(np.nansum(worth)) if worth.size else 0.0


def _group(findings: Sequence[Finding]) -> str:
    if len(findings) == 1:
        return sentence(findings[0])
    first = findings[0]
    if first.recording and first.throughout:  # several recordings have it, each for itself
        key = phrase_of(first).key
        sizes = [
            abs(float(f.parameters[key])) for f in findings if f.parameters.get(key) is not None
        ]
        unit = first.units.get(key, "")
        size = f" of {plain(min(sizes), 2)} to {plain(max(sizes), 2)} {unit}" if sizes else ""
        return f"{first.title}{size} in {len({f.recording for f in findings})} recordings"
    ordered = sorted(findings, key=lambda f: f.joints)
    joints = [j for f in ordered for j in f.joints]
    verb = phrase_of(first).verb
    said = f"{who(first.effect, joints)} {verb} {first.title}{_values(ordered)}"
    return f"{span(first)} {said}" if span(first) else said


def _values(findings: Sequence[Finding]) -> str:
    """Main parameters of findings of one kind, in brackets; of more than three their range."""
    key = phrase_of(findings[0]).key
    values = [float(f.parameters[key]) for f in findings if f.parameters.get(key) is not None]
    if len(values) < len(findings):
        return ""
    factor, unit = shown_unit(max(values, key=abs), findings[0].units.get(key, ""))
    shown = [plain(factor * value, 2) for value in (values if len(values) < 4 else sorted(values))]
    if len(shown) < 4:
        return f" ({listed(shown)} {unit})"
    low, high = shown[0], shown[-1]
    return f" ({low if float(low) == float(high) else f'{low} to {high}'} {unit})"


def _shrink(result: GapResult) -> str:
    """Torque error before and after, of all joints together and of that which is left worst."""
    before, after = (np.asarray(x.torque_rmse_nm) for x in (result.before, result.after))
    known = np.isfinite(before) & np.isfinite(after)
    joint = worst_joint(result)
    if joint is None:
        return ""
    total = fall(*(float(np.sqrt(np.sum(x[known] ** 2))) for x in (before, after)))
    seen = " (in sample only: nothing could be held out)" if result.in_sample else ""
    unit = result.unit("N m", joint)
    if known.sum() == 1:
        return f"torque error {total} {unit}{seen}"
    worst = f"{fall(before[joint], after[joint])} of joint {joint + 1}, the worst"
    if len({*result.slides}) > 1:  # newtons and newton metres are not added up
        return f"torque error {worst.replace(' of', f' {unit} of')}{seen}"
    return f"torque error {total} {unit} over all joints, {worst}{seen}"


def worst_joint(result: GapResult) -> int | None:
    """The joint (from 0) whose torque error is left largest; None where none is known."""
    before, after = (np.asarray(x.torque_rmse_nm) for x in (result.before, result.after))
    known = np.flatnonzero(np.isfinite(before) & np.isfinite(after))
    return max(map(int, known), key=lambda j: (after[j], before[j]), default=None)


def worse(result: GapResult) -> str:
    """Joints on which the new model is clearly worse than the old one; empty where none is."""
    before, after = (np.asarray(x.torque_rmse_nm) for x in (result.before, result.after))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(before > 0.0, after / before - 1.0, 0.0)
    joints = [int(j) + 1 for j in np.flatnonzero(share > WORSE)]
    if not joints:
        return ""
    most = f"{'up to ' if len(joints) > 1 else ''}{plain(100.0 * float(np.nanmax(share)), 2)} %"
    return f"but {most} worse on joint{'s' if len(joints) > 1 else ''} {numbered(joints)}"


def fall(before: float, after: float) -> str:
    """What an error was and what it has become.

    >>> fall(1.924, 0.0213), fall(0.05, 0.002)
    ('1.92 -> 0.02', '0.050 -> 0.002')
    """
    digits = 2 if after >= 0.01 else 3
    return f"{before:.{digits}f} -> {after:.{digits}f}"


def _left(result: GapResult) -> str:
    """Unexplained residuals in one clause; of each joint the largest."""
    worst: dict[int, Leftover] = {}
    for item in sorted(result.unexplained, key=lambda item: item.rmse_nm):
        worst[item.joint] = item
    if len(worst) <= 1:
        return "".join(leftover_sentence(item, result) for item in worst.values())
    joints = sorted(worst)
    sizes = listed([plain(worst[j].rmse_nm, 2) for j in joints])
    return f"joints {numbered(joints)}: {sizes} {result.unit('N m')} {NOT_EXPLAINED}"


def _instant(t: float) -> str:
    return f"{t:.2f}".rstrip("0").rstrip(".")


LABEL = 26  # characters


def console_summary(result: GapResult) -> list[str]:
    """Headline, findings, figures by joint, what to do next; for `rich.console.Console.print`."""
    color = "red" if result.problem is not None else "bold"
    lines = [f"[{color}]{escape(headline(result))}[/{color}]"]
    for findings in by_kind(result.findings):
        lines += _found(findings)
        others = [rivals(same) for same in alike(findings)]
        lines += [f"  [dim]{escape(other)}[/dim]" for other in others if other]
    lines += carried(result)
    lines += [f"[red]![/red] {escape(text)}" for text in result.contradictions]
    lines += [
        f"[yellow]?[/yellow] {escape(leftover_sentence(x, result))}" for x in result.unexplained
    ]
    left = left_above_noise(result) if result.findings and not result.unexplained else ""
    lines += [f"[yellow]?[/yellow] {escape(left)}, and no effect of the catalogue names it"] * (
        left != ""
    )
    lines += _figures(result)
    lines += [f"[cyan]next[/cyan] {escape(text)}" for text in result.what_next]
    lines += [f"[dim]note[/dim] {escape(text)}" for text in result.notes]
    if result.model_out is not None:
        lines.append(f"model {escape(result.model_out)}")
    return lines


def _found(findings: Sequence[Finding]) -> list[str]:
    """Findings of one kind: one sentence, and below it a line per joint where there are several."""
    if len(findings) == 1:
        (finding,) = findings
        there = "that one of them is there " if finding.two_readings else ""
        sure = f"evidence {there}{percent(finding.evidence)}, z {plain(finding.detectability, 2)}"
        return [f"[green]•[/green] {escape(sentence(finding))} [dim]({sure})[/dim]"]
    lines = [f"[green]•[/green] {escape(_group(findings))}"]
    for finding in sorted(findings, key=lambda f: (f.recording, f.joints)):
        where = finding.recording or who(finding.effect, finding.joints)
        sure = f"evidence {percent(finding.evidence)}, z {plain(finding.detectability, 2)}"
        values = ", ".join(parameter_lines(finding))
        lines.append(f"    {escape(f'{where}: {values}')} [dim]({sure})[/dim]")
    return lines


def carried(result: GapResult) -> list[str]:
    """What each of several recordings carries, a line each; for a console."""
    rows = [(load.recording, *carried_words(load)) for load in result.loads]
    wide = max((len(name) for name, *_ in rows), default=0)
    head = ["what each recording carries"] if rows else []
    return head + [
        f"  {escape(f'{name:<{wide}}  {mass}  {centre}'.rstrip())}" for name, mass, centre in rows
    ]


def carried_words(load: LogLoad) -> tuple[str, str]:
    """Mass, and centre where it is shown."""
    mass = f"{plus_minus(load.mass_kg, load.mass_std_kg)} kg"
    if not load.shown:
        return f"nothing shown ({mass})", ""
    if load.com_m is None or load.com_std_m is None:
        return mass, "centre not shown"
    pairs = zip("xyz", load.com_m, load.com_std_m, strict=True)
    centre = ", ".join(f"{axis} {plus_minus(1e3 * x, 1e3 * std)}" for axis, x, std in pairs)
    return mass, f"centre {centre} mm in {load.frame}"


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
    said = result.unit("N m, mrad").partition(" (")[2]
    return [f"figures by joint, {said.removesuffix(')')} in its place"] * bool(said) + [
        f"{name:<{LABEL}} " + " ".join(f"{plain(factor * x, 3):>7}" for x in values)
        for name, values, factor in rows
        if values is not None and np.isfinite(values).any()
    ]
