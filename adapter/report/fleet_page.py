"""What a fleet found: in words, as figures, and as a page."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from adapter.effects.active import SHOWN_STD
from adapter.effects.base import with_squares
from adapter.effects.catalogue import effects_by_name, learned_effect
from adapter.effects.law import LearnedLaw
from adapter.gap.workflow import names_of
from adapter.model.numbers import plus_minus
from adapter.model.self_model import LEAST_STD
from adapter.report.html import fill, write_whole
from adapter.report.style import Drawing, Panel, joint_color, legend
from adapter.report.tables import Table
from adapter.report.words import NARROW, with_doubt
from adapter.runs.fleet.arm import DAY_S, TIME, FleetArm, OfLog
from adapter.runs.fleet.course import Drift
from adapter.runs.fleet.fleet import Fleet
from adapter.runs.fleet.moments import EPOCH_S

HEADS = ("recording", "begins", "s", "load, kg", "fit, N m", "once more", "disagrees")
MOST_ROWS = 300  # of recordings on the page; of more those to say something of
MOMENTS = ("path", "content", "begin_s", "span_s", "samples", "notes")  # of a recording, as figures


def log_rows(arm: FleetArm, numbers: Iterable[int]) -> list[tuple[str, ...]]:
    """Recordings as rows under `HEADS`, by their numbers."""
    names, rows = called(arm), list[tuple[str, ...]]()
    for k in numbers:
        log, begin_s = arm.logs[k], arm.logs[k].moments.begin_s
        worst, begins = int(np.argmax(log.rmse)), f"{begin_s:.1f} s"
        if begin_s >= EPOCH_S:
            begins = f"{datetime.fromtimestamp(begin_s, UTC):%Y-%m-%d %H:%M}"
        load = "" if log.load is None else _signed(*log.load)
        fit = f"{log.rmse[worst]:.3f} ({worst + 1})"
        few = len(log.disagrees) < 4  # joints to be named in a table
        others = " ".join(map(str, log.disagrees)) if few else "everywhere"
        cells = begins, f"{log.moments.span_s:.0f}", load, fit, _less(log.worth), others
        rows.append((names[k], *cells))
    return rows


def called(arm: FleetArm) -> list[str]:
    """Names of an arm's recordings, with folders where two have the same; of runs the folders."""
    names = names_of([log.moments.path for log in arm.logs])
    return [name.removesuffix("/recording.mcap") for name in names]


def to_be_shown(arm: FleetArm, most: int) -> list[int]:
    """Numbers of an arm's recordings: all, or of more than `most` those to say something of."""
    if len(arm.logs) <= most:
        return list(range(len(arm.logs)))
    out = {x.number for x in arm.standing_out}
    out |= {k for k, x in enumerate(arm.logs) if x.load is not None or x.disagrees}
    return sorted(out)[:most]


def _signed(value: float, std: float) -> str:
    return "+" * (value > 0.0) + with_doubt(value, std)


def drift_words(drift: Drift) -> str:
    """A sentence."""
    effect, per = learned_effect(drift.effect), f"per unit of {drift.follows}"
    unit = effect.parameters[0].written
    per = "a day" if drift.follows == TIME else per
    share = f" ({100.0 * drift.span / abs(drift.usual):.0f} % of it)" if drift.usual else ""
    or_ = "".join(f" or {x}" for x in drift.rivals)
    doubt = "; these recordings cannot tell which" if drift.rivals else ""
    return (
        f"{effect.title.capitalize()} of joint {drift.joint} follows {drift.follows}{or_}: "
        f"{_signed(drift.slope, drift.std)} {unit} {per}, {drift.span:.3g} {unit} over all"
        f"{share}{doubt}"
    )


def standing_out_words(arm: FleetArm) -> Iterator[str]:
    """A sentence for each recording with parameters that the others do not have."""
    names, by_log = called(arm), dict[int, list[str]]()
    for x in arm.standing_out:
        effect = learned_effect(x.effect)
        by_log.setdefault(x.number, []).append(
            f"{effect.title.lower()} of joint {x.joint} is {x.value:.3g} "
            f"{effect.parameters[0].written} where {x.expected:.3g} was to be expected"
        )
    for number, told in sorted(by_log.items()):
        yield f"{names[number]} stands out: {'; '.join(told)}"


def sentences(arm: FleetArm) -> list[str]:
    """What there is to say of an arm's recordings."""
    found = [drift_words(x) for x in arm.drifts]
    names = called(arm)
    for name, log in zip(names, arm.logs, strict=True):
        if log.disagrees:
            worst = int(np.argmax(log.rmse / log.own_rmse))
            found.append(
                f"{name} disagrees with the others on "
                f"joint {', '.join(map(str, log.disagrees))}: {log.rmse[worst]:.2g} N m on joint "
                f"{worst + 1} where a model of its own leaves {log.own_rmse[worst]:.2g}; another "
                f"arm, or a change{'' if log.used else '; the model is learned without it'}"
            )
    found += standing_out_words(arm)
    noted = dict[str, list[str]]()
    for name, log in zip(names, arm.logs, strict=True):
        for note in log.moments.notes:
            noted.setdefault(note, []).append(name)
    for note, of in noted.items():
        found.append(f"{', '.join(of) if len(of) < 4 else f'{len(of)} recordings'}: {note}")
    used = [(x, name) for name, x in zip(names, arm.logs, strict=True) if x.used]
    if len(used) > 1:
        best, name = max(used, key=lambda one: one[0].worth)
        found.append(
            f"The motion of {name} would teach most if repeated: standard deviations would be "
            f"{_less(best.worth)} less (geometric mean)"
        )
    return found


def _less(worth: float) -> str:
    """By how much standard deviations become less with so many nats a parameter more."""
    return f"{-100.0 * np.expm1(-worth):.2g}{NARROW}%"


def summary(found: Fleet) -> list[str]:
    """What was done, in one line."""
    arms = len(found.arms)
    parts = ["1 arm" if arms == 1 else f"{arms} arms"]
    parts.append(f"{found.read} recording{'s' * (found.read != 1)} read")
    left = {"broken": found.broken, "forgotten": found.forgotten, "only planned": found.plans}
    numbers = {"known": found.known, **{word: len(x) for word, x in left.items()}}
    parts += [f"{number} {word}" for word, number in numbers.items() if number]
    return [", ".join(parts), *_law_words(found)]


def _law_words(found: Fleet) -> Iterator[str]:
    """A sentence for each law that some arms have on a joint and others have not."""
    laws = effects_by_name(found.arms[0].effects) if found.arms else ()
    for k, law in enumerate(laws):
        for j in range(found.arms[0].model.tree.n) if isinstance(law, LearnedLaw) else ():
            own = [
                (x.name, x.outcome.effects[k, j], x.outcome.effects_std[k, j]) for x in found.arms
            ]
            has = {name: abs(c) > SHOWN_STD * std for name, c, std in own}
            if len(set(has.values())) > 1:
                said = [f"{x} {'has' if has[x] else 'not'} ({plus_minus(*c)})" for x, *c in own]
                where = f"joint {j + 1} ({with_squares(law.unit)})"
                yield f"Not all arms have a {law.title} on {where}: {', '.join(said)}"


def as_json(found: Fleet) -> dict[str, Any]:
    """As figures."""
    return {
        "read": found.read,
        "known": found.known,
        "broken": [x._asdict() for x in found.broken],
        "forgotten": list(found.forgotten),
        "alike": [list(pair) for pair in found.alike],
        "plans": list(found.plans),
        "arms": [_arm_json(arm) for arm in found.arms],
        "notes": summary(found)[1:],
    }


def _arm_json(arm: FleetArm) -> dict[str, Any]:
    std, outs = arm.outcome.effects_std, arm.standing_out
    values = zip(arm.effects, arm.outcome.effects, std, strict=False)
    return {
        "name": arm.name,
        "theta": arm.model.theta,
        "theta_std": arm.model.theta_std,
        "effects": {name: {"value": value, "std": own} for name, value, own in values},
        "drifts": [asdict(x) for x in arm.drifts],
        "standing_out": [{**x._asdict(), "path": arm.logs[x.number].moments.path} for x in outs],
        "logs": [
            {
                **{key: getattr(log.moments, key) for key in MOMENTS},
                "load": None if log.load is None else log.load._asdict(),
                "rmse_nm": log.rmse,
                "own_rmse_nm": log.own_rmse,
                "used": log.used,
                "disagrees": list(log.disagrees),
                "worth_nats": log.worth,
            }
            for log in arm.logs
        ],
        "notes": sentences(arm),
    }


def write_fleet_page(found: Fleet, path: str | Path) -> Path:
    """Write the page: arm by arm what holds, what drifts, what each log carried.

    Raises:
        RunFolderError: the file cannot be written.
    """
    told = {"lines": summary(found), "arms": [_arm(arm) for arm in found.arms]}
    broken = Table(("recording", "why"), list(found.broken))
    context = {**told, "broken": broken, "forgotten": found.forgotten}
    return write_whole(path, fill("fleet.html", context))


def _arm(arm: FleetArm) -> dict[str, Any]:
    """An arm's part of the page."""
    numbers = to_be_shown(arm, MOST_ROWS)
    left = len(arm.logs) - len(numbers)
    note = f"{left} more in the table file; here are those there is something to say of"
    logs = Table(HEADS, log_rows(arm, numbers), note=note * (left > 0))
    used = [x for x in arm.logs if x.used]
    panels = _courses(arm, used) if len(used) > 1 else []
    told = {"name": arm.name, "lines": sentences(arm), "parameters": _parameters(arm)}
    return {**told, "panels": panels, "logs": logs}


def _parameters(arm: FleetArm) -> Table:
    """What is learned of each joint and of the link that it moves; θ whole is in the model file."""
    heads = ["joint", "mass of its link", *(learned_effect(name).title for name in arm.effects)]
    units = ["", "kg", *(learned_effect(name).parameters[0].written for name in arm.effects)]
    std = arm.outcome.effects_std
    links = len(arm.model.theta) - arm.model.tree.n  # a base that floats comes first
    rows = []
    for j, name in enumerate(arm.model.tree.joint_names):
        shown = arm.model.theta_std[links + j, 0] > LEAST_STD
        mass = arm.model.theta[links + j, 0], arm.model.theta_std[links + j, 0] if shown else None
        values = [with_doubt(arm.outcome.effects[k, j], std[k, j]) for k in range(len(std))]
        rows.append([name, with_doubt(*mass), *values])
    said = "A mass without a standard deviation is the documentation's"
    return Table(heads, rows, units, f"{said}: torques show it in sums only.")


def _courses(arm: FleetArm, used: list[OfLog]) -> list[Panel]:
    """What each recording alone says of friction and offsets, joint by joint, over their begins."""
    begin = np.array([log.moments.begin_s for log in used])
    days = (begin - begin.min()) / DAY_S
    label = "days after the first recording" if begin.min() > EPOCH_S else "days on the arm's clock"
    if begin.min() < EPOCH_S and (np.ptp(days) < 1.0 or begin.max() >= EPOCH_S):  # own clocks
        days, label = np.arange(1.0, len(used) + 1.0), "recording, as in the table"
    panels = []
    for k, name in enumerate(arm.effects):
        drawing = Drawing("half")
        ax = drawing.axes[0]
        for j in range(used[0].effects.shape[1]):
            y = np.array([log.effects[k, j] for log in used])
            std = np.array([log.effects_std[k, j] for log in used])
            look = ax.errorbar(days, y, std, color=joint_color(j), linewidth=1.0, elinewidth=0.6)
            look.set_label(str(j + 1))
        legend(ax, ncols=8, fontsize=6, loc="lower center", bbox_to_anchor=(0.5, 0.98))
        drawing.figure.subplots_adjust(top=0.9)  # for the legend
        ax.set_xlabel(label)
        effect = learned_effect(name)
        unit = effect.parameters[0].written
        panels.append(drawing.panel(effect.title, unit, "by joint, with standard deviations"))
    return panels
