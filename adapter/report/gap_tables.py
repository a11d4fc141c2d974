"""Tables of the gap report as rows of text: findings, errors by joint, rivals, corrections."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapter.gap import words
from adapter.gap.phrases import parameter_lines, shown_unit, who
from adapter.gap.result import Finding, GapResult, Unseen
from adapter.model.inertia import PARAMETERS, UNITS
from adapter.model.numbers import DASH, plain, plus_minus
from adapter.model.spatial import Array
from adapter.report.tables import Table, by_column
from adapter.report.words import NARROW, capital

UNIT = re.compile(
    r"(?<=\d) (N m s/rad|N m/rad|N m/s|N m|kg m²|kg m|kg|N|mrad|rad|mm|ms|s|%)(?![\w²])"
)


def tied(text: str) -> str:
    """Words as a page shows them: a true minus, no line break between a number and its unit."""
    text = re.sub(r"(?<![\w.])-(?=\d)", "−", text).replace(" ± ", f"{NARROW}±{NARROW}")
    return UNIT.sub(lambda found: NARROW + found[1].replace(" ", NARROW), text)


@dataclass(frozen=True)
class FindingRow:
    """A finding as it stands in the table."""

    what: str
    where: str
    when: str
    values: list[str]
    evidence: str
    worth: str


def finding_row(findings: Sequence[Finding]) -> FindingRow:
    """What, where, when, how much, how sure: one row for what is the same on several joints."""
    first = findings[0]
    ordered = sorted(findings, key=lambda f: (f.recording, f.joints))
    joints = sorted({j for f in ordered for j in f.joints})
    least, alone = min(f.evidence for f in ordered), len(ordered) == 1
    sure = words.percent(least).replace("more than", ">")
    if first.recording and not alone:
        when = f"in {len({f.recording for f in ordered})} recordings"
    else:
        when = words.span(first) or "throughout"
    lines = [[tied(line) for line in parameter_lines(f)] for f in ordered]
    values = lines[0] if alone else []
    if in_matrix(ordered):
        values = [f"{_ranges(ordered)}; joint by joint below"]
    elif not alone:
        owners = [f.recording or who(f.effect, f.joints) for f in ordered]
        values = [f"{x}: {', '.join(own)}" for x, own in zip(owners, lines, strict=True)]
    evidence = sure if alone or least >= 0.999 else f"{sure} and more"
    what, where = capital(first.title), who(first.effect, joints)
    return FindingRow(what, where, when, values, evidence, _worth(ordered))


def in_matrix(findings: Sequence[Finding]) -> bool:
    """Whether findings of one effect stand joint by joint: numbers, one set for each of several
    joints of the whole recording."""
    joints = [f.joints[0] for f in findings if len(f.joints) == 1 and not f.recording]
    numbers = all(np.ndim(value) == 0 for f in findings for value in f.parameters.values())
    alike = len({tuple(f.parameters) for f in findings}) == 1
    return numbers and alike and len(findings) > 1 and len(set(joints)) == len(findings)


def _ranges(findings: Sequence[Finding]) -> str:
    """Each parameter from its smallest to its largest."""
    said = []
    for key in findings[0].parameters:
        factor, unit = _unit(findings, key)
        values = [factor * float(f.parameters[key]) for f in findings]
        said.append(f"{key} = {_from_to(values)} {unit}")
    return tied(", ".join(said))


def _from_to(values: Sequence[float]) -> str:
    low, high = plain(min(values), 2), plain(max(values), 2)
    return low if low == high else f"{low} to {high}"


def _unit(findings: Sequence[Finding], key: str) -> tuple[float, str]:
    """(factor, name) of the unit in which a parameter of all of them is shown."""
    largest = max((float(f.parameters[key]) for f in findings), key=abs)
    return shown_unit(largest, findings[0].units.get(key, ""))


def joint_matrix(result: GapResult) -> Table | None:
    """What several joints have, a row per joint and a column per parameter of an effect; None
    where no effect is of several."""
    columns = [("Joint", "", list(result.joint_names))]
    for findings in filter(in_matrix, words.by_kind(result.findings)):
        first = findings[0]
        for key in first.parameters:
            factor, unit = _unit(findings, key)
            cells = [DASH] * len(result.joint_names)
            for f in findings:
                std = factor * np.asarray(f.std.get(key, np.nan), float)
                cells[f.joints[0] - 1] = tied(plus_minus(factor * f.parameters[key], std))
            said = ", ".join(filter(None, (key, unit, words.span(first))))
            columns.append((capital(first.title), said, cells))
    return by_column(columns) if len(columns) > 1 else None


def _worth(findings: Sequence[Finding]) -> str:
    sizes = [np.asarray(f.torque_rms_nm, dtype=float) for f in findings]
    most = [float(np.nanmax(x)) for x in sizes if np.isfinite(x).any()]
    return tied(f"{_from_to(most)} N m") if most else DASH


def rival_rows(result: GapResult) -> list[tuple[str, str, str]]:
    """(findings, what else they could be and how much of them that explains, how to tell)."""
    rows = []
    for findings in words.alike(result.findings):
        shares = words.shares_of(findings)
        if shares:
            joints = sorted(j for f in findings for j in f.joints)
            where = f"{capital(findings[0].title)}, {who(findings[0].effect, joints)}"
            said = ", ".join(f"{words.title_of(name)} {share}" for name, share in shares)
            rows.append((where, said, findings[0].split_by))
    return rows


def carried_table(result: GapResult) -> Table | None:
    """What each of several recordings carries; None for one."""
    rows = [[load.recording, *map(tied, words.carried_words(load))] for load in result.loads]
    return Table(["Recording", "Load", "Where"], rows) if rows else None


def unseen_table(result: GapResult) -> Table | None:
    """Sizes that effects would have needed to be named, a row each; None where nothing is known."""
    rows: dict[str, list[Unseen]] = {}
    for own in result.unseen:
        rows.setdefault(own.effect, []).append(own)
    heads = ["Effect", "Arm", *(f"Joint {j + 1}" for j in range(len(result.joint_names)))]
    body = []
    for effect, every in rows.items():
        factor, unit = shown_unit(min(x.size for x in every), every[0].unit)
        of = {x.joint: plain(factor * x.size, 2) for x in every}
        cells = [of.get(j, DASH) for j in range(len(heads) - 1)]
        way = "above" if every[0].above else "below"
        body.append([f"{capital(words.title_of(effect))} {way}, {unit}", *cells])
    return Table(heads, body) if body else None


def error_table(result: GapResult) -> Table:
    """Errors before and after by joint: torque in N m and times its noise, rollouts in mrad."""
    before, after = result.before, result.after
    heads = ["Joint", "Noise", *["Before", "After"] * 2]
    own = result.unit("N m")
    units = ["", own, *[f"torque, {own}"] * 2, *["× noise"] * 2]
    noise = np.asarray(result.noise_floor_nm, dtype=float)
    columns = [noise, before.torque_rmse_nm, after.torque_rmse_nm, *words.noise_times(result)]
    rollouts = ("rollout, mrad", "rollout_rmse_rad"), ("rollout, mrad/s", "rollout_rmse_rad_s")
    for unit, key in rollouts:
        pair = getattr(before, key), getattr(after, key)
        if all(x is None or not np.isfinite(x).any() for x in pair):
            continue
        nothing = np.full(len(noise), np.nan)
        columns += [nothing if x is None else 1e3 * np.asarray(x, dtype=float) for x in pair]
        heads += ["Before", "After"]
        units += [result.unit(unit)] * 2
    rows = [[name, *(plain(x[j]) for x in columns)] for j, name in enumerate(result.joint_names)]
    return Table(heads, rows, units, "× noise: in its band, where the joint slides.")


def correction_table(result: GapResult) -> Table | None:
    """The largest parts of the inertial correction; None without any."""
    ratio = correction_ratio(result)
    if ratio is None or result.corrections is None or result.corrections_prior is None:
        return None
    rows = []
    for place in np.argsort(-np.abs(ratio), axis=None)[:6]:
        link, part = np.unravel_index(place, ratio.shape)
        if ratio[link, part] == 0.0:
            break
        by = tied(f"{result.corrections[link, part]:+.2g} {UNITS[part]}")
        prior = f"± {plain(result.corrections_prior[link, part], 2)} {UNITS[part]}"
        times = tied(f"{ratio[link, part]:+.1f}")
        rows.append([f"link {link + 1}", PARAMETERS[part], by, prior, times])
    heads = ["Link", "Parameter", "Correction", "Expected", "In units of it"]
    return Table(heads, rows) if rows else None


def correction_ratio(result: GapResult) -> Array | None:
    """(n, 10) corrections in standard deviations of their prior, 0 where nothing was allowed."""
    if result.corrections is None or result.corrections_prior is None:
        return None
    prior = np.asarray(result.corrections_prior, dtype=float)
    known = np.isfinite(prior) & (prior > 0.0) & np.isfinite(result.corrections)
    return np.where(known, result.corrections / np.where(known, prior, 1.0), 0.0)
