"""Laws in closed form in place of patterns that no effect of the catalogue explains."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np

from adapter.effects.by_joint import STRIBECK_SPEED
from adapter.effects.catalogue import CATALOGUE
from adapter.effects.law import Curve, Law, OverSignals
from adapter.gap.candidates import Candidate, Pattern, prior_log_odds, ranges, signal_of
from adapter.gap.evidence import Noise
from adapter.gap.fit import Fit, Named, between, place_of, refitted, shaped, under_own_noise
from adapter.gap.real_arm import BRISTLES
from adapter.gap.rivals import price
from adapter.gap.scan import BELIEF, BEST_OF_JOINT, FORMS, Lead, SignatureTable

STRIBECK = CATALOGUE["stribeck_friction"]
STEP = 0.1  # of what was seen: between two settings that are tried


def lawful(fit: Fit, without: Container[int] = ()) -> Fit:
    """With laws in place of each joint's patterns, and of its curves over the angle, that lose.

    Joints (from 0) that are `without` any law keep what they have.
    """
    for joint in sorted({e.candidate.joint for e in fit.named if _gives_way(e)}):
        if any(e.candidate.joint == joint and _nameless(e) for e in fit.named):
            fit = falling(fit, joint)
        fit = _of_joint(fit, joint, 3 if joint not in without else 0)  # more are a curve
    return fit


def left_without(before: Fit, after: Fit) -> set[int]:
    """Joints (from 0) that had a pattern and are left without any law or curve."""
    had = {e.candidate.joint for e in before.named if _is_curve(before, e)}
    return had - {
        e.candidate.joint for e in after.named if isinstance(e.candidate.effect, OverSignals)
    }


def notes_on(fit: Fit) -> list[str]:
    """Of each law: what it does with the joint's energy, and how far it was seen."""
    notes: list[str] = []
    for k, e in enumerate(fit.named):
        law, joint = e.candidate.effect, e.candidate.joint
        if not isinstance(law, Law | Curve):
            continue
        where = fit.recordings[e.recording or 0]
        motion = where.motion
        power = fit.model.contribution(e.recording or 0, k)[:, joint] * where.low_dq[:, joint]
        given = float(-power[power < 0.0].sum() / max(np.abs(power).sum(), 1e-12))
        if law.variables == {"q"} and not law.by:
            does = "stores energy and gives it back, as a spring does"
        elif given < 0.03:  # share of exchanged energy that a law may feed in and count as friction
            does = "takes energy, as friction does"
        else:
            does = f"feeds energy in: {given:.0%} of what it exchanges".replace("%", " %")
        own, ranges = law.by - 1 if law.by else joint, []
        for name in sorted(law.variables - {"tau"}):
            x = getattr(motion, name)[:, own]
            ranges.append(f"{name}{own + 1} from {x.min():.2f} to {x.max():.2f}")
        beyond = "stays as it is there" if isinstance(law, Curve) else "goes on as written"
        seen = f"; seen over {' and '.join(ranges)}, beyond it {beyond}" if ranges else ""
        notes.append(f"joint {joint + 1}: a {law.title} {does}{seen}")
    return notes


def _of_joint(fit: Fit, joint: int, most: int) -> Fit:
    """Patterns as laws, or as the curves that they are; a law must clearly beat a name.

    Both are weighed under the least noise that any leaves: what is not right leaves more, and
    would make itself harder to tell.
    """
    places = [k for k, e in enumerate(fit.named) if e.candidate.joint == joint and _gives_way(e)]
    rest = [e for k, e in enumerate(fit.named) if k not in places]
    lawful, _ = refitted(fit.with_named(rest))
    for _ in range(most):
        before, lawful = lawful, _with_law(lawful, joint)
        if lawful is before:
            break
    new = range(len(rest), len(lawful.named))
    if new:
        least = _least(fit, under_own_noise(lawful)[0], joint)
        asked = _together(fit.with_noise(least), places)
        if any(fit.named[k].is_pattern for k in places):
            asked -= BELIEF
        elif not any(_nameless(fit.named[k]) for k in places):
            asked += BELIEF
        if _together(lawful.with_noise(least), new) > asked:
            return lawful
    fit = fit.with_named([_as_curve(fit, e) if k in places else e for k, e in enumerate(fit.named)])
    for k in places:
        if isinstance(fit.named[k].candidate.effect, Law):
            fit = _settled(fit, k)
    return fit


def falling(fit: Fit, joint: int) -> Fit:
    """With bristles whose level falls with the speed, where that says more than what has no name.

    Bristles of one level have the doubt of slow rows, which hides that they are not of one level.
    """
    places = [k for k, e in enumerate(fit.named) if e.candidate.joint == joint and _nameless(e)]
    bare = fit.with_named([e for k, e in enumerate(fit.named) if k not in places])
    for k, e in enumerate(bare.named):
        if e.candidate.effect is not BRISTLES or e.candidate.joint != joint:
            continue
        template = STRIBECK.reshaped({"vs": STRIBECK_SPEED, "s0": e.values["s0"]}, 1.0)[0]
        odds = prior_log_odds(STRIBECK, joint, fit.n, len(STRIBECK.templates()))
        falling = Named(
            Candidate(STRIBECK, template, joint, (), odds, e.candidate.slides), np.repeat(e.x, 2)
        )
        other, _ = under_own_noise(shaped(refitted(bare.instead(k, falling))[0], k))
        asked, found = (
            replace(x, noise=_least(fit, other, joint), doubts=other.doubts) for x in (bare, other)
        )
        a, b = (_together(refitted(x)[0], [k]) for x in (asked, found))
        if other.named[k].possible and b > a + BELIEF:
            return other.with_named([*other.named, *(fit.named[i] for i in places)])
    return fit


def _least(fit: Fit, other: Fit, joint: int) -> tuple[Noise, ...]:
    """The noise of that which leaves less of a joint's torque."""
    return min((fit.noise, other.noise), key=lambda own: max(float(x.level[joint]) for x in own))


def _together(fit: Fit, places: Sequence[int]) -> float:
    """Nats that named effects are worth together, their odds included."""
    own = np.concatenate([place_of(fit, k) for k in places])
    carried = fit.carried()
    found = carried.worth(own, np.delete(np.arange(len(carried.g)), own))
    return found.log_evidence + sum(price(fit.named[k]) for k in places)


def _nameless(named: Named) -> bool:
    """Whether it is a pattern, or a law that took a name's place."""
    return named.is_pattern or isinstance(named.candidate.effect, Law)


def _gives_way(named: Named) -> bool:
    """Whether a law may take its place: it is none, or a curve over the angle that is not right."""
    return _nameless(named) or (named.candidate.effect.over_angle and not named.assumed)


def _with_law(fit: Fit, joint: int) -> Fit:
    """With one more law, of one of several recordings as well, or as it is where none is believed.

    Those that are best at the settings tried are compared each at its own best setting.
    """
    best: dict[str, Lead] = {}
    table = SignatureTable(fit, [joint], FORMS, rich=False)
    leads = [*table.whole(), *table.apart(table.candidates)]
    for lead in sorted(leads, key=lambda lead: -lead.log_evidence):
        if lead.candidate.possible(lead.x, lead.interval_s):
            best.setdefault(lead.candidate.effect.name, lead)
    found, most, place = fit, BELIEF, len(fit.named)
    for lead in list(best.values())[:BEST_OF_JOINT]:
        if lead.log_evidence > BELIEF:
            new = Named(lead.candidate, lead.x, lead.interval_s, lead.recording)
            more = _settled(fit.with_named((*fit.named, new)), place)
            nats = _together(more, [place])
            if nats > most:
                found, most = more, nats
    return found


def _as_curve(fit: Fit, named: Named) -> Named:
    """A pattern as the effect that it is, in one recording; those of time stay what they are."""
    pattern = named.candidate.effect
    if not _is_curve(fit, named):
        return named
    assert isinstance(pattern, Pattern) and pattern.curve is not None
    at = fit.model.stages(0)
    x = signal_of(pattern.curve.signal, at.links, at.rigid, named.candidate.joint)
    template = pattern.curve.between(float(x.min()), float(x.max()))
    candidate = replace(named.candidate, effect=pattern.curve, template=template)
    return replace(named, candidate=candidate)


def _is_curve(fit: Fit, named: Named) -> bool:
    pattern = named.candidate.effect
    return isinstance(pattern, Pattern) and pattern.curve is not None and len(fit.recordings) == 1


def _settled(fit: Fit, place: int) -> Fit:
    """With the setting of a law, if it has one, between those that were tried."""
    named = fit.named[place]
    law, c = named.candidate.effect, named.candidate
    assert isinstance(law, Law)
    setting = law.expression.setting
    if setting is None or setting.wave:
        return refitted(fit)[0]

    def at(value: float) -> Named:
        template = law.at(max(value, setting.lower))
        template = replace(template, prior_std=c.template.prior_std)
        return replace(named, candidate=replace(c, template=template))

    stages = [fit.model.stages(i) for i in range(len(fit.recordings))]
    low, high = ranges(stages, c.joint)[setting.within]
    step = STEP * (high - low) * (1.0 if setting.within else float(np.ptp(setting.tried)))
    return refitted(between(fit, place, float(named.values[setting.key]), step, at))[0]


def in_doubt(fit: Fit) -> Fit:
    """With the settings of laws free, about what they are: for their standard deviations."""
    named = list(fit.named)
    for k, e in enumerate(named):
        law, c = e.candidate.effect, e.candidate
        around = law.around(e.values, float(c.prior_std[0])) if isinstance(law, Law) else None
        if around is not None:
            x = np.array([e.x[0], 0.0])
            named[k] = replace(e, candidate=replace(c, template=around), x=x)
    return fit if named == list(fit.named) else fit.with_named(named)
