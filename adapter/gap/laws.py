"""Laws in closed form in place of patterns that no effect of the catalogue explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.law import Curve, Law
from adapter.gap.candidates import Pattern, signal_of
from adapter.gap.fit import Fit, Named, place_of, refitted
from adapter.gap.rivals import price
from adapter.gap.scan import BELIEF, FORMS, SignatureTable

MOST_TERMS = 3  # of one joint: more are a curve with another name
PASSIVE = 0.03  # share of exchanged energy that a law may feed in and count as friction
ROUNDS = 2  # in which a setting is fitted about where it was


def lawful(fit: Fit) -> Fit:
    """With laws in place of the patterns of each joint where they are worth as much.

    All are weighed under the noise that the patterns leave, the patterns too: an expression that is
    not the right one leaves more than they do. A curve must be clearly better than a law.
    """
    for joint in sorted({e.candidate.joint for e in fit.named if e.is_pattern}):
        fit = _of_joint(fit, joint)
    for k, e in enumerate(fit.named):  # those that took a name's place
        if isinstance(e.candidate.effect, Law) and e.candidate.template.linear:
            fit = _settled(fit, k)
    return fit


def notes_on(fit: Fit) -> list[str]:
    """Of each law: what it does with the joint's energy, and how far it was seen."""
    notes, motion = [], fit.recordings[0].motion
    for k, e in enumerate(fit.named):
        law, joint = e.candidate.effect, e.candidate.joint
        if not isinstance(law, Law | Curve) or e.recording is not None:
            continue
        power = fit.model.contribution(0, k)[:, joint] * fit.recordings[0].low_dq[:, joint]
        given = float(-power[power < 0.0].sum() / max(np.abs(power).sum(), 1e-12))
        if law.variables == {"q"} and not law.by:
            does = "stores energy and gives it back, as a spring does"
        elif given < PASSIVE:
            does = "takes energy, as friction does"
        else:
            does = f"feeds energy in: {given:.0%} of what it exchanges".replace("%", " %")
        own, ranges = law.by - 1 if law.by else joint, []
        for name in sorted(law.variables - {"tau"}):
            x = getattr(motion, name)[:, own]
            ranges.append(f"{name}{own + 1} from {x.min():.2f} to {x.max():.2f}")
        beyond = "stays as it is there" if isinstance(law, Curve) else "goes on as written"
        seen = f"; seen over {' and '.join(ranges)}, beyond it {beyond}" if ranges else ""
        notes.append(f"joint {joint + 1}: {law.title} {does}{seen}")
    return notes


def _of_joint(fit: Fit, joint: int) -> Fit:
    places = [k for k, e in enumerate(fit.named) if e.is_pattern and e.candidate.joint == joint]
    if any(fit.named[k].interval_s != WHOLE for k in places):
        return fit
    own = np.concatenate([place_of(fit, k) for k in places])
    carried = fit.carried()
    asked = carried.worth(own, np.delete(np.arange(len(carried.g)), own)).log_evidence
    asked += sum(price(fit.named[k]) for k in places)
    kept, worth = [e for k, e in enumerate(fit.named) if k not in places], 0.0
    lawful, _ = refitted(fit.with_named(kept))
    for _ in range(MOST_TERMS):
        table = SignatureTable(lawful, [joint], FORMS, rich=False)
        best = max(table.whole(), key=lambda lead: lead.log_evidence)
        if best.log_evidence < BELIEF:
            break
        worth += best.log_evidence
        more = lawful.with_named((*lawful.named, Named(best.candidate, best.x)))
        lawful = _settled(more, len(more.named) - 1)
    if worth > asked - BELIEF:
        return lawful
    return fit.with_named(
        [_as_curve(fit, e) if k in places else e for k, e in enumerate(fit.named)]
    )


def _as_curve(fit: Fit, named: Named) -> Named:
    """A pattern as the effect that it is, in one recording; those of time stay what they are."""
    pattern = named.candidate.effect
    assert isinstance(pattern, Pattern)
    if pattern.curve is None or len(fit.recordings) > 1:
        return named
    at = fit.model.stages(0)
    x = signal_of(pattern.curve.signal, at.links, at.rigid, named.candidate.joint)
    template = pattern.curve.between(float(x.min()), float(x.max()))
    candidate = replace(named.candidate, effect=pattern.curve, template=template)
    return replace(named, candidate=candidate)


def _settled(fit: Fit, place: int) -> Fit:
    """With the setting of a law, if it has one, fitted beside all else."""
    for _ in range(ROUNDS):
        named = fit.named[place]
        effect, c = named.candidate.effect, named.candidate
        assert isinstance(effect, Law)
        around = effect.around(named.values, float(c.prior_std[0]))
        if around is not None:
            x = np.array([named.x[0], 0.0])
            fit = fit.instead(place, replace(named, candidate=replace(c, template=around), x=x))
        fit, _ = refitted(fit)
    return fit
