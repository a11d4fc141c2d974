"""Compares what `adapter gap` said of hidden-effect trials with their truth."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Entry = Mapping[str, Any]
Row = dict[str, Any]
STRONG_Z = 8.0
DATE_S = 0.3
SHARE, STDS = 0.1, 3.0  # a parameter may be off by a tenth of its size or three deviations
SURE = 0.9
SUMS = ("asymmetric_friction", "load_dependent_friction", "friction_drift")
EVIDENCE = (0.0, 0.5, 0.9, 0.99, 1.0)  # said with less than the second it should be no name
# Numbers that are parts of one vector are judged by its length; angles by a radian.
VECTORS = (("cx", "cy", "cz"), ("rx", "ry"), ("fx", "fy", "fz"))
ANGLES, SKIPPED = ("phase", "q0"), ("n", "inertia", "dtheta", "mx", "my", "mz")
WILSON = 1.96


def wilson(hits: int, of: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927); (0, 1) of none."""
    if not of:
        return 0.0, 1.0
    z2, p = WILSON**2, hits / of
    middle = (p + z2 / (2 * of)) / (1 + z2 / of)
    half = WILSON * np.sqrt(p * (1 - p) / of + z2 / (4 * of * of)) / (1 + z2 / of)
    return float(middle - half), float(middle + half)


def same_joints(finding: Entry, effect: Entry) -> bool:
    """Whether both sit on the same joints; all of them counts as none named."""
    if {finding["effect"], effect["effect"]} & {"payload", "base_tilt", "external_wrench"}:
        return True
    pair = [sorted(x.get("joints") or []) for x in (finding, effect)]
    return pair[0] == pair[1] or all(len(joints) in (0, 7) for joints in pair)


def right_name(finding: Entry, effect: Entry) -> bool:
    """The truth's own name on the right joints."""
    return bool(finding["effect"] == effect["effect"]) and same_joints(finding, effect)


def ambiguous_names(finding: Entry) -> list[str]:
    """Names that the finding says it may be as well; entries are names or carry one."""
    names = finding.get("ambiguous_with") or []
    return [x if isinstance(x, str) else x.get("effect", x.get("name", "")) for x in names]


def covers(finding: Entry, effect: Entry) -> bool:
    """Right name, or the truth is listed in the ambiguity set, on the right joints."""
    if right_name(finding, effect):
        return True
    return effect["effect"] in ambiguous_names(finding) and same_joints(finding, effect)


def rubs_right(finding: Entry, truth: Entry) -> bool:
    """Whether it may be a name for the friction that every joint of the truth has."""
    rubs = set(truth.get("rubs") or [])
    return bool(rubs & {finding["effect"], *ambiguous_names(finding)})


def parameters_right(finding: Entry, effect: Entry) -> bool:
    """Every number within a tenth of its size or three of its standard deviations."""
    truth, found = dict(effect["parameters"]), dict(finding["parameters"])
    std = dict(finding.get("std") or {})
    groups: list[tuple[str, ...]] = [keys for keys in VECTORS if keys[0] in truth]
    grouped = {key for keys in groups for key in keys}
    groups += [(key,) for key in truth if key not in grouped and key not in SKIPPED]
    for keys in groups:
        if any(not isinstance(found.get(key), int | float) for key in keys):
            return False
        off = np.array([found[key] - truth[key] for key in keys])
        if keys == ("phase",):
            off = np.angle(np.exp(1j * off))
        scale = np.linalg.norm([truth[key] for key in keys])
        room = SHARE * (1.0 if keys[0] in ANGLES else scale)
        deviations = np.array([STDS * float(std.get(key) or 0.0) for key in keys])
        if np.linalg.norm(off) > room and np.any(np.abs(off) > deviations):
            return False
    return True


def date_errors(finding: Entry, effect: Entry) -> list[float]:
    """By how much the start (and the end, where there is one) are off, s; inf where not dated."""
    span, said = effect.get("interval_s"), finding.get("interval_s") or [None, None]
    if not span:
        return []
    found = [x if x is not None else np.inf for x in said]
    return [abs(float(found[i]) - float(x)) for i, x in enumerate(span) if x is not None]


def score_trial(result: Entry, truth: Entry, z: Sequence[float]) -> Row:
    """What a result got right.

    Args:
        result: as `adapter gap --json` writes it.
        truth: contents of the truth file.
        z: detectability of each effect of the truth, in its order.
    """
    findings, effects = list(result.get("findings") or []), list(truth["effects"])
    outside = truth["kind"] == "outside"
    known = [] if outside else effects
    strong = [e for e, size in zip(known, z, strict=False) if size > STRONG_Z]
    on = [e["joints"][-1:] for e in effects if outside]  # of a pair the joint that feels it
    laws = [f["effect"].startswith("law: ") and list(f["joints"]) in on for f in findings]
    right = [
        law or rubs_right(f, truth) or any(covers(f, e) for e in known)
        for f, law in zip(findings, laws, strict=True)
    ]
    wrong = [f for f, ok in zip(findings, right, strict=True) if not ok]
    evidence = [float(f.get("evidence") or 0.0) for f in findings]
    # beside friction in every joint the size of another one is that of the sum
    sized = [e for e in strong if not (truth.get("rubs") and e["effect"] in SUMS)]
    exact = [(f, e) for e in known for f in findings if right_name(f, e)]
    dates = [error for f, e in exact for error in date_errors(f, e)[:1]]
    matched = [e for e in strong if any(right_name(f, e) for f in findings)]
    return {
        "seed": truth["seed"],
        "kind": truth["kind"],
        "z": [float(x) for x in z],
        "effects": [(e["effect"], list(e["joints"])) for e in effects],
        "found": [(f["effect"], list(f.get("joints") or [])) for f in findings],
        "strong": len(strong),
        "named": sum(any(covers(f, e) for f in findings) for e in strong),
        "exact": bool(strong) and len(matched) == len(strong) and not wrong,
        "wrong": [f["effect"] for f in wrong],
        "rubs": bool(truth.get("rubs")),
        "evidence": list(zip(evidence, right, strict=True)),
        "sure_wrong": sum(x > SURE and not ok for x, ok in zip(evidence, right, strict=True)),
        "unexplained": bool(result.get("unexplained")) or any(laws),
        "parameters": [parameters_right(f, e) for f, e in exact if any(e is x for x in sized)],
        "date_errors_s": dates,
    }


def _strong(row: Row) -> bool:
    return bool(row["z"]) and max(row["z"]) > STRONG_Z


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Every number that the issue asks for, as [share, low, high, hits, of], and the confusion."""
    nulls = [r for r in rows if r["kind"] == "null"]
    pairs = [r for r in rows if r["kind"] == "pair"]
    outside = [r for r in rows if r["kind"] == "outside"]
    singles = [r for r in rows if r["kind"] == "single" and _strong(r)]
    rubbed = [r for r in rows if r["rubs"]]
    both = [r for r in pairs if r["strong"] == len(r["effects"])]
    seen = [r for r in outside if _strong(r)]
    parameters = [ok for r in singles for ok in r["parameters"]]
    dates = [error for r in rows for error in r["date_errors_s"]]
    counts = {
        "single_named": [r["named"] > 0 for r in singles],
        "single_exact": [r["exact"] for r in singles],
        "parameters": parameters,
        "null_false": [bool(r["wrong"]) for r in nulls],
        "rubbed_named": [r["named"] > 0 for r in singles if r["rubs"]],
        "rubbed_clean": [not r["wrong"] for r in rubbed if r["kind"] != "outside"],
        "pair_both_named": [r["named"] == r["strong"] for r in both],
        "dated": [error <= DATE_S for error in dates],
        "outside_unexplained": [r["unexplained"] for r in seen],
        "outside_sure_wrong": [r["sure_wrong"] > 0 for r in seen],
        "torque_ratio": [r["torque_ratio"] <= 1.2 for r in rows if r.get("torque_ratio")],
        "rollout_ratio": [r["rollout_ratio"] <= 1.3 for r in rows if r.get("rollout_ratio")],
    }
    shares = {key: _share(hits) for key, hits in counts.items()}
    return {
        "shares": shares,
        "calibration": calibration(rows),
        "confusion": confusion(rows),
        "trials": len(rows),
    }


def calibration(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """How often names are right, by the evidence they were said with: see `_share`."""
    said = [pair for row in rows for pair in row["evidence"]]
    return {
        f"{low:g} to {high:g}": _share([ok for x, ok in said if low <= x < high or x == high == 1])
        for low, high in itertools.pairwise(EVIDENCE)
    }


def _share(hits: Sequence[bool]) -> list[Any]:
    share = sum(hits) / len(hits) if hits else None
    return [share, *wilson(sum(hits), len(hits)), sum(hits), len(hits)]


def confusion(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    """Truth (singles by name and strength, nulls, outside) against the first name said."""
    table: dict[str, Counter[str]] = {}
    for row in (r for r in rows if r["kind"] != "pair"):
        name = row["effects"][0][0] if row["effects"] else "(null)"
        if row["effects"] and not _strong(row):
            name += " (weak)"
        said = "+".join(sorted({f[0] for f in row["found"]}))
        if not said:
            said = "(unexplained)" if row["unexplained"] else "(nothing)"
        table.setdefault(name, Counter())[said] += 1
    return {name: dict(counts) for name, counts in sorted(table.items())}


# Key -> (what it says, goal).
GOALS = {
    "single_named": ("single effects named, or in the ambiguity set", ">= 95 %"),
    "single_exact": ("single effects: exactly the right set and joint", ">= 90 %"),
    "parameters": ("parameters within 10 % or 3 std", ">= 90 %"),
    "null_false": ("nulls given a name", "<= 2 %"),
    "rubbed_named": ("beside friction in every joint: single named", ">= 95 %"),
    "rubbed_clean": ("beside friction in every joint: no wrong name", ">= 95 %"),
    "pair_both_named": ("pairs: both named", ">= 80 %"),
    "dated": ("starts dated within 0.3 s", ">= 90 %"),
    "outside_unexplained": ("outside the catalogue: unexplained, or a law", ">= 80 %"),
    "outside_sure_wrong": ("outside: wrong name with evidence > 0.9", "<= 10 %"),
    "torque_ratio": ("held-out torque within 1.2 of the oracle's", "all"),
    "rollout_ratio": ("forward simulation within 1.3 of the oracle's", "all"),
}


def table(figures: Mapping[str, Any]) -> str:
    """The summary as text to read."""
    lines = [f"{figures['trials']} trials"]
    for key, (what, goal) in GOALS.items():
        share, low, high, hits, of = figures["shares"][key]
        if of:
            told = f"{100 * share:5.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
            lines.append(f"{what:50s} {told:24s} {hits}/{of}  {goal}")
    for key, (share, low, high, hits, of) in figures["calibration"].items():
        if of:
            told = f"{100 * share:5.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
            lines.append(
                f"{'names said with ' + key + ' that are right':50s} {told:24s} {hits}/{of}"
            )
    lines.append("truth -> said")
    for name, said in figures["confusion"].items():
        parts = sorted(said.items(), key=lambda item: -item[1])
        lines.append(f"  {name:34s} " + ", ".join(f"{other} {count}" for other, count in parts))
    return "\n".join(lines)
