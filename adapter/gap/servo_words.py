"""What was found of an arm's servos, in sentences and in the JSON file."""

from __future__ import annotations

from typing import Any

from rich.markup import escape

from adapter.gap.phrases import listed, numbered, shown_unit
from adapter.gap.servo_model import ground_facts
from adapter.gap.servo_result import EFFECTS, ServoFinding, ServoGap
from adapter.model.numbers import plain, plus_minus


def headline(gap: ServoGap) -> str:
    """The outcome in one sentence."""
    units = [gap.unit("mrad", j) for j in range(len(gap.joint_names))]
    kinds = {u: [j for j, own in enumerate(units) if own == u] for u in sorted({*units})[::-1]}
    before, after = (  # of joints that turn, and of those that slide
        " and ".join(f"{plain(1e3 * float(x[j].max()), 2)} {u}" for u, j in kinds.items())
        for x in (gap.before, gap.after)
    )
    if not gap.findings and gap.ground.root == 0.0:
        return f"the arm does what its servos' documentation says: tracking as foretold to {before}"
    parts = [_short(finding) for finding in gap.findings]
    if gap.ground.root > 0.0:
        parts.insert(0, f"the hand came down on something {_height(gap)}")
    hand = " -> ".join(f"{plain(1e3 * x[-1], 2)} mm" for x in (gap.hand_before, gap.hand_after))
    said = (
        f"tracking error of the worst joint {before} -> {after}, at the hand {hand} ({gap.scored})"
    )
    left = [f"joint {numbered(gap.worse)}: not better"] if gap.worse else []
    return "; ".join([*parts, said, *left])


def _height(gap: ServoGap) -> str:
    height = round(100.0 * gap.ground.height)  # cm: what moves it between starts of the search
    side = "above" if height > 0 else "below"
    return f"about {abs(height)} cm {side} the base's origin" if height else "as high as the base"


def grounded(gap: ServoGap) -> str:
    """Where and for how long, and whether it is foretold with."""
    link, point = gap.joint_names[gap.ground.link], ", ".join(f"{x:.3f}" for x in gap.ground.point)
    fitted = zip(gap.recordings, gap.touched, strict=False)  # those held out come behind
    times = [f"{plain(s, 2)} s of {name}" for name, s in fitted if s]
    said = (
        f"the link behind {link} came down at ({point}) m of its frame on something level "
        f"{_height(gap)}, of {plain(gap.ground.root**2, 2)} N/m and with a coefficient of friction "
        f"of {plain(gap.ground.rubs, 2)}, for {listed(times)}; the servos are fitted beside it"
    )
    if gap.servos.ground.root > 0.0:
        return said
    return said + (
        " and foretell without it: one motion does not tell where it lies in other poses; record "
        "a second one that touches it, or none that does"
    )


def _short(finding: ServoFinding) -> str:
    joints = f"joint{'s' if len(finding.joints) > 1 else ''} {numbered(finding.joints)}"
    if finding.effect == "servo_delay":
        return f"commands act {1e3 * finding.values[0]:.2f} ms late"
    factor, unit = shown_unit(finding.values[0], finding.unit)
    values = listed([plain(factor * value, 3) for value in finding.values])
    known = any(value is not None for value in finding.documented)
    than = " is not as documented" if known else ""
    return f"{EFFECTS[finding.effect][0]} of {joints}{than}: {values} {unit}"


def lines(gap: ServoGap) -> list[str]:
    """Headline, a table of findings, figures by joint; for `rich.console.Console.print`."""
    found = [f"[bold]{escape(headline(gap))}[/bold]"]
    for finding in gap.findings:
        found.append(f"[green]•[/green] {escape(EFFECTS[finding.effect][0])}")
        rows = zip(finding.joints, finding.values, finding.std, finding.documented, strict=True)
        factor, unit = shown_unit(finding.values[0], finding.unit)
        for j, value, std, documented in rows:
            known = "" if documented is None else f", documented {plain(factor * documented, 4)}"
            said = f"{plus_minus(factor * value, factor * std)} {unit}{known}"
            found.append(f"  joint {j}: {escape(said)}")
        if finding.open:
            found.append(f"  [dim]{escape(finding.open)}[/dim]")
    if gap.ground.root > 0.0:
        found.append(f"[green]•[/green] {escape(grounded(gap))}")
    if gap.scale_open:
        which = numbered(gap.scale_open)
        found.append(
            f"[yellow]?[/yellow] joint {which}: the documented masses hardly load it, so that its "
            "gains, friction and inertia are known but for a common factor"
        )
    errors = {
        f"tracking error before, {gap.unit('mrad')}": gap.before,
        f"               after, {gap.unit('mrad')}": gap.after,
        "at the hand before, mm, and all": gap.hand_before,
        "            after, mm, and all": gap.hand_after,
    }
    wide = max(map(len, errors))
    found += [
        f"{name:<{wide}} " + " ".join(f"{plain(1e3 * x, 3):>7}" for x in error)
        for name, error in errors.items()
    ]
    return found + [f"[dim]note[/dim] {escape(text)}" for text in gap.notes]


def as_json(gap: ServoGap) -> dict[str, Any]:
    """What the JSON file holds."""
    findings = []
    for f in gap.findings:
        key = EFFECTS[f.effect][1]
        findings.append(
            {
                "effect": f.effect,
                "joints": f.joints,
                "parameters": {key: f.values},
                "std": {key: f.std},
                "units": {key: f.unit},
                "documented": {key: f.documented},
                "not_told_apart": f.open or None,
            }
        )
    return {
        "headline": headline(gap),
        "joint_names": gap.joint_names,
        "slides": gap.slides,
        "model": gap.model_name,
        "recordings": gap.recordings,
        "findings": findings,
        "hand": gap.hand,
        **{
            when: {
                "tracking_rmse_rad": error,
                "hand_rmse_m": float(way[-1]),
                "hand_rmse_by_joint_m": way[:-1],
            }
            for when, error, way in (
                ("before", gap.before, gap.hand_before),
                ("after", gap.after, gap.hand_after),
            )
        },
        "scored_on": gap.scored,
        "scale_open": gap.scale_open,
        "ground": ground_facts(gap.ground, gap.joint_names),
        "touched_s": gap.touched,
        "notes": gap.notes,
    }
