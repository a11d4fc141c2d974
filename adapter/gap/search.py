"""The search: one lead after the other, each believed only once it has paid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.base import JOINT, TorqueEffect
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, Named, refitted, worth
from adapter.gap.patterns import Pattern
from adapter.gap.rivals import Standing, pays_held_out, price, simpler_wins, standing
from adapter.gap.scan import Field, Lead

BELIEF = 8.0  # nats that a finding is worth after the price of looking for it
CHI2_LEAST = 30.0
LOOKED_AT, PATTERNS, TRIED = 40, 15, 3  # leads of a round: under their own noise; refitted
ROUNDS = 12
MOST_SWAPS = 12
SWAP_NATS = 1.0
SURE_NATS = 20.0  # a lead that may be taken along with another joint's
CHANGE_NATS = 6.0  # by which acting from some time on must beat acting always
CHANGE_SHARE = 0.04  # of the squared distance explained, a nat each: no arm is quite steady

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Found:
    """What a search ended with.

    Attributes:
        fit: the model, under its own noise; carried: what is known of its coefficients.
        standings: of each named effect among its rivals.
    """

    fit: Fit
    carried: Carried
    standings: tuple[Standing, ...]


def leads_of(field: Field) -> list[Lead]:
    """The best leads first, no two of one effect on one joint and of one kind of interval."""
    best: dict[tuple[str, int, str], Lead] = {}
    for lead in field.whole():
        if lead.candidate.effect.possible(_values(lead)):
            _keep(best, lead, "whole")
    # a pattern may change in mid-recording as well, but then it is a pattern all the more
    chosen = [x.candidate for x in best.values() if not isinstance(x.candidate.effect, Pattern)]
    for lead in field.timed(chosen):
        if lead.candidate.effect.possible(_values(lead)):
            _keep(best, lead, "timed")
    for lead in field.passing([c for c in chosen if c.effect.name == "external_wrench"]):
        _keep(best, lead, "passing")
    return sorted(best.values(), key=lambda lead: -lead.log_evidence)


def honest_leads(field: Field, refused: set[tuple[str, int]]) -> list[Lead]:
    """The leads worth trying, under their own noise, in the order in which to try them.

    What is simpler goes first: always before from some time on, an effect before its finer
    form, an effect of the catalogue before a pattern, unless the other explains clearly more.
    """
    leads = [x for x in leads_of(field) if x.candidate.key not in refused]
    named = [x for x in leads if not isinstance(x.candidate.effect, Pattern)]
    others = [x for x in leads if isinstance(x.candidate.effect, Pattern)]
    chosen = [x for x in (*named[:LOOKED_AT], *others[:PATTERNS]) if x.log_evidence > BELIEF]
    found = [x for x in map(field.honest, chosen) if x.log_evidence > BELIEF]
    found = [x for x in found if not any(outdone(x, y) for y in found)]
    return sorted(found, key=lambda x: -x.log_evidence)


def outdone(lead: Lead, by: Lead) -> bool:
    """Whether a simpler lead says all but the same."""
    a, b = lead.candidate, by.candidate
    if lead is by:
        return False
    if a.key == b.key:
        more = lead.interval_s != WHOLE and by.interval_s == WHOLE
        return more and lead.log_evidence < by.log_evidence + CHANGE_NATS + CHANGE_SHARE * by.chi2
    return simpler_wins((b, by.chi2), (a, lead.chi2))


def _keep(best: dict[tuple[str, int, str], Lead], lead: Lead, kind: str) -> None:
    key = (*lead.candidate.key, kind)
    if key not in best or lead.log_evidence > best[key].log_evidence:
        best[key] = lead


def _values(lead: Lead) -> dict:  # type: ignore[type-arg]
    return lead.candidate.template.decode(lead.x)


def search(fit: Fit, joints: Sequence[int], progress: Progress = lambda text: None) -> Found:
    """Name what is missing.

    Args:
        fit: the nominal model on the recordings, with any noise model.
        joints: (from 0) that move.
        progress: hears what is being tried.
    """
    fit, _ = refitted(fit)
    refused: set[tuple[str, int]] = set()
    for _ in range(ROUNDS):
        field = Field(fit, joints)
        fit, accepted = field.fit, False
        done = refused | {e.candidate.key for e in fit.named}
        honest = [x for x in honest_leads(field, done) if x.chi2 > CHI2_LEAST]
        for lead in honest[:TRIED]:
            progress(f"{lead.candidate.effect.title}, joint {lead.candidate.joint + 1}")
            trial = _with(fit, lead)
            if trial is None:
                refused.add(lead.candidate.key)
                continue
            fit, accepted = trial, True
            fit = _alongside(fit, lead, honest)
            break
        if not accepted:
            break
    return settled(fit, joints)


def _alongside(fit: Fit, first: Lead, honest: Sequence[Lead]) -> Fit:
    """With the plain leads of other joints, which do not touch the first one."""
    taken = {first.candidate.joint, -1}
    for lead in honest:
        c = lead.candidate
        if c.joint in taken or lead.log_evidence < BELIEF + SURE_NATS or lead.interval_s != WHOLE:
            continue
        taken.add(c.joint)  # the best lead of a joint decides, whatever it is
        if isinstance(c.effect, TorqueEffect) and c.effect.scope == JOINT:
            fit = _with(fit, lead) or fit
    return fit


def _with(fit: Fit, lead: Lead) -> Fit | None:
    """The model with a lead named, refitted; None where it does not pay under its own noise."""
    new = Named(lead.candidate, lead.x, lead.interval_s, lead.recording)
    trial, carried = refitted(replace(fit, named=(*fit.named, new)))
    if lead.interval_s != WHOLE:
        trial = dated(trial, len(trial.named) - 1)
    trial = shaped(trial, len(trial.named) - 1).with_noise()
    trial, carried = refitted(trial)
    last = len(trial.named) - 1
    found = worth(trial, carried, last)
    if found.log_evidence + price(trial.named[last]) < BELIEF or found.chi2 < CHI2_LEAST:
        return None
    if not pays_held_out(trial, carried, last):
        return None
    return trial if all(e.candidate.effect.possible(e.values) for e in trial.named) else None


def dated(fit: Fit, place: int) -> Fit:
    """A named effect with the start (and end) that the data like best, on a grid of 12 ms."""
    for reach in (0.15, 0.04, 0.012):
        for side in (0, 1):
            centre = fit.named[place].interval_s[side]
            if np.isfinite(centre):
                trials = [_moved(fit, place, side, centre + reach * k) for k in range(-3, 4)]
                fit = min(trials, key=_distance)
        fit, _ = refitted(fit, 1)
    return fit


def shaped(fit: Fit, place: int) -> Fit:
    """A named effect with the nonlinear setting that the data like best."""
    for step in (1.25, 1.08, 1.03):
        named = fit.named[place]
        trials = [fit]
        for ratio in (step**-2, 1.0 / step, step, step**2):
            template = named.candidate.effect.reshaped(named.values, ratio)
            if template is None:
                return fit
            other = replace(named, candidate=replace(named.candidate, template=template))
            changed = (*fit.named[:place], other, *fit.named[place + 1 :])
            trials.append(refitted(replace(fit, named=changed), 1)[0])
        fit = min(trials, key=_distance)
    return fit


def _moved(fit: Fit, place: int, side: int, t: float) -> Fit:
    named = list(fit.named)
    interval = list(named[place].interval_s)
    interval[side] = t
    named[place] = replace(named[place], interval_s=(interval[0], interval[1]))
    return replace(fit, named=tuple(named))


def _distance(fit: Fit) -> float:
    """Squared distance, in units of the noise, with what the coefficients cost."""
    white = fit.whiten(fit.residuals())
    return float(white @ white + np.sum((fit.coefficients / fit.prior_std) ** 2))


def settled(fit: Fit, joints: Sequence[int]) -> Found:
    """Without what no longer pays beside the others, each by its best name, under its own noise."""
    for _ in range(MOST_SWAPS):
        fit, carried = refitted(fit.with_noise())
        bad = _worst(fit, carried)
        if bad is not None:
            fit = replace(fit, named=fit.named[:bad] + fit.named[bad + 1 :])
            continue
        field = Field(fit, joints, rich=False)
        standings = [standing(fit, carried, field, k) for k in range(len(fit.named))]
        swapped = _swapped(fit, standings)
        if swapped is None:
            break
        fit = swapped
    return Found(fit, carried, tuple(standings))


def _worst(fit: Fit, carried: Carried) -> int | None:
    """The named effect that is least worth having, if one is not."""
    found = [worth(fit, carried, k) for k in range(len(fit.named))]
    values = [s.log_evidence + price(e) for s, e in zip(found, fit.named, strict=True)]
    bad = [
        k
        for k, (s, e) in enumerate(zip(found, fit.named, strict=True))
        if values[k] < BELIEF
        or s.chi2 < CHI2_LEAST
        or not e.candidate.effect.possible(e.values)
        or not pays_held_out(fit, carried, k)
    ]
    return min(bad, key=lambda k: values[k]) if bad else None


def _swapped(fit: Fit, standings: Sequence[Standing]) -> Fit | None:
    """The model with its worst named effect under a better name, if there is one."""
    taken = {e.candidate.key for e in fit.named}
    best, gain = None, SWAP_NATS
    for k, own in enumerate(standings):
        for rival in own.rivals:
            c = rival.candidate
            better = own.gain(rival)
            if (
                better > gain
                and c.key not in taken
                and c.effect.possible(c.template.decode(rival.x))
            ):
                best, gain = (k, rival), better
                break
    if best is None:
        return None
    k, rival = best
    other = replace(fit.named[k], candidate=rival.candidate, x=rival.x)
    return replace(fit, named=(*fit.named[:k], other, *fit.named[k + 1 :]))
