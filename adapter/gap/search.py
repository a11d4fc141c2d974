"""The search: one lead after the other, each believed only once it has paid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, Named, refitted, worth
from adapter.gap.scan import Field, Lead, log_odds

BELIEF = 7.0  # nats that a finding is worth after the price of looking for it
CHI2_LEAST = 30.0
TRIED = 4  # leads of a round
ROUNDS = 8
CHANGE_NATS = 6.0  # by which acting from some time on must beat acting always
PASSING_NATS = 6.0

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Found:
    """What a search ended with.

    Attributes:
        fit: the model, under its own noise; carried: what is known of its coefficients.
        field: all signatures about it, for rivals and for what is left.
        values: (named,) evidence of each finding, nats.
        chi2: (named,) fall of the squared distance.
    """

    fit: Fit
    carried: Carried
    field: Field
    values: tuple[float, ...]
    chi2: tuple[float, ...]


def leads_of(field: Field) -> list[Lead]:
    """The best leads first, no two of one effect on one joint."""
    whole = [x for x in field.whole() if x.candidate.effect.possible(_values(x))]
    best: dict[tuple[str, int], Lead] = {}
    for lead in whole:
        _keep(best, lead)
    chosen = [lead.candidate for lead in best.values()]
    for lead in field.timed(chosen):
        if lead.candidate.effect.possible(_values(lead)):
            _keep(best, lead, CHANGE_NATS)
    passing = [c for c in chosen if c.effect.name == "external_wrench"]
    for lead in field.passing(passing):
        _keep(best, lead, PASSING_NATS)
    return sorted(best.values(), key=lambda lead: -lead.log_evidence)


def _keep(best: dict[tuple[str, int], Lead], lead: Lead, margin: float = 0.0) -> None:
    old = best.get(lead.candidate.key)
    if old is None or lead.log_evidence > old.log_evidence + margin:
        best[lead.candidate.key] = lead


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
        leads = [x for x in leads_of(field) if x.candidate.key not in done]
        for lead in leads[:TRIED]:
            if lead.log_evidence < BELIEF or lead.chi2 < CHI2_LEAST:
                break
            progress(f"{lead.candidate.effect.title}, joint {lead.candidate.joint + 1}")
            trial = _with(fit, lead)
            if trial is None:
                refused.add(lead.candidate.key)
                continue
            fit, accepted = trial, True
            break
        if not accepted:
            break
    return _pruned(fit, joints)


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
    return trial if all(e.candidate.effect.possible(e.values) for e in trial.named) else None


def price(named: Named) -> float:
    """ln of what a named effect was worth before the data (negative)."""
    timed, passing = named.interval_s != WHOLE, np.isfinite(named.interval_s[1])
    odds = log_odds(named.candidate, timed=timed, passing=bool(passing))
    return odds - np.log(50.0) * (timed + passing)


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


def _pruned(fit: Fit, joints: Sequence[int]) -> Found:
    """Without what no longer pays beside the others, under the final noise."""
    while True:
        fit, carried = refitted(fit.with_noise())
        found = [worth(fit, carried, k) for k in range(len(fit.named))]
        values = [s.log_evidence + price(e) for s, e in zip(found, fit.named, strict=True)]
        bad = [
            k
            for k, (s, v, e) in enumerate(zip(found, values, fit.named, strict=True))
            if v < BELIEF or s.chi2 < CHI2_LEAST or not e.candidate.effect.possible(e.values)
        ]
        if not bad:
            chi2 = tuple(s.chi2 for s in found)
            return Found(fit, carried, Field(fit, joints), tuple(values), chi2)
        worst = min(bad, key=lambda k: values[k])
        fit = replace(fit, named=fit.named[:worst] + fit.named[worst + 1 :])
