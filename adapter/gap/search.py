"""The search: one lead after the other, each believed only once it has paid."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.base import JOINT, TorqueEffect
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, Named, refitted, under_own_noise, worth
from adapter.gap.noise import Noise
from adapter.gap.patterns import Pattern
from adapter.gap.rivals import (
    PATTERN_SHARE,
    Standing,
    pays_held_out,
    price,
    simpler_wins,
    standing,
)
from adapter.gap.scan import CATALOGUED, PATTERNS, Field, Lead

BELIEF = 8.0  # nats that a finding is worth after the price of looking for it
CHI2_LEAST = 30.0
PATIENCE_S = 35.0  # after which nothing further is sought
BEST_OF_ALL, BEST_OF_JOINT = 6, 4  # leads of a round that are looked at under their own noise
TRIED = 3
BUNDLE = (
    "coulomb_friction",
    "viscous_friction",
    "torque_offset",
)  # leads of a round: under their own noise; refitted
CURVE, CURVE_SHARE = {"joint_spring", "torque_ripple"}, 1.1
ROUNDS = 12
MOST_SWAPS = 4
SWAP_NATS = 1.0
SURE_NATS = 20.0  # a lead that may be taken along with another joint's
CHANGE_NATS = 6.0  # by which acting from some time on must beat acting always
CHANGE_SHARE = 0.1  # of the squared distance explained, a nat each: no arm is quite steady

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Found:
    """What a search ended with.

    Attributes:
        fit: the model, under its own noise; carried: what is known of its coefficients.
        standings: of each named effect among its rivals.
        known: what is known of them with the inertias free within their prior, where `carried`
            holds these fast.
    """

    fit: Fit
    carried: Carried
    standings: tuple[Standing, ...]
    known: Carried | None = None


@dataclass(frozen=True, eq=False)
class Move:
    """Leads to be named together, and their evidence."""

    leads: tuple[Lead, ...]
    log_evidence: float

    @property
    def joint(self) -> int:
        """Where they are, from 0; -1 for the arm."""
        return self.leads[0].candidate.joint

    @property
    def plain(self) -> bool:
        """Whether they only add torque on their joint, all the time."""
        return all(
            isinstance(x.candidate.effect, TorqueEffect)
            and x.candidate.effect.scope == JOINT
            and x.interval_s == WHOLE
            for x in self.leads
        )


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


def honest_moves(field: Field, refused: set[tuple[str, int]]) -> list[Move]:
    """What is worth trying, under its own noise, in the order in which to try it.

    What is simpler goes first: always before from some time on, an effect before its finer
    form, unless the other explains clearly more. Friction and an offset can hide each other:
    they are also tried together.
    """
    leads = [x for x in leads_of(field) if x.candidate.key not in refused]
    found = [x for x in map(field.honest, _shortlist(leads)) if x.log_evidence > BELIEF]
    found = [x for x in found if x.chi2 > CHI2_LEAST]
    found = [x for x in found if not any(outdone(x, y) for y in found)]
    moves = [Move((x,), x.log_evidence) for x in found] + _bundles(field, leads, found)
    return sorted(moves, key=lambda x: -x.log_evidence)


def _shortlist(leads: Sequence[Lead]) -> list[Lead]:
    """The best leads of each joint and the best of all."""
    seen: dict[int, int] = {}
    chosen = []
    for place, lead in enumerate(leads):
        if lead.log_evidence < BELIEF:
            break
        joint = lead.candidate.joint
        plain = lead.candidate.effect.name in BUNDLE and lead.interval_s == WHOLE
        if plain or place < BEST_OF_ALL or seen.get(joint, 0) < BEST_OF_JOINT:
            chosen.append(lead)
            seen[joint] = seen.get(joint, 0) + 1
    return chosen


def _bundles(field: Field, leads: Sequence[Lead], found: Sequence[Lead]) -> list[Move]:
    """Friction with an offset, on each joint where they say more together than one of them."""
    moves = []
    for joint in {x.candidate.joint for x in leads}:
        own = [
            x
            for x in leads
            if x.candidate.joint == joint
            and x.candidate.effect.name in BUNDLE
            and x.interval_s == WHOLE
        ]
        if len(own) < 2 or max(x.log_evidence for x in own) < BELIEF:
            continue
        worth_it = field.together(own).log_evidence + sum(x.odds for x in own)
        alone = max((x.log_evidence for x in found if x.candidate.joint == joint), default=BELIEF)
        if worth_it > alone + BELIEF:
            moves.append(Move(tuple(own), worth_it))
    return moves


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


def _values(lead: Lead) -> dict:
    return lead.candidate.template.decode(lead.x)


def search(fit: Fit, joints: Sequence[int], progress: Progress = lambda text: None) -> Found:
    """Name what is missing.

    The catalogue goes first. What is left then may follow a pattern that no effect has; and
    where an effect was named for want of a better word, the pattern takes its place.

    Args:
        fit: the nominal model on the recordings, with any noise model.
        joints: (from 0) that move.
        progress: hears what is being tried.
    """
    begun = time.monotonic()
    fit, _ = refitted(fit)
    fit = settled(_extended(fit, joints, CATALOGUED, progress, begun), joints).fit
    if fit.named:  # noise that was taken for the first effect's may have hidden another one
        fit = _extended(fit, joints, CATALOGUED, progress, begun)
    fit = _extended(fit, joints, PATTERNS, progress, begun)
    fit = _renamed(fit, joints)
    return settled(fit, joints)


def _extended(fit: Fit, joints: Sequence[int], kind: str, progress: Progress, begun: float) -> Fit:
    """With all that pays of one kind of candidates."""
    refused: set[tuple[str, int]] = set()
    for _ in range(ROUNDS):
        field = Field(fit, joints, kind)
        fit, accepted = field.fit, False
        moves = honest_moves(field, refused | {e.candidate.key for e in fit.named})
        for move in moves[:TRIED]:
            trial = _with(fit, move, field.fit.noise, progress)
            if trial is None:
                refused |= {x.candidate.key for x in move.leads if len(move.leads) == 1}
                continue
            fit, accepted = _alongside(trial, move, moves, field, progress), True
            break
        if not accepted or time.monotonic() - begun > PATIENCE_S:
            break
    return fit


def _renamed(fit: Fit, joints: Sequence[int]) -> Fit:
    """Patterns in place of effects that explain clearly less than a pattern does alone.

    A spring and a ripple on one joint are two words for one curve over the angle; a pattern
    need not explain more than both together.
    """
    for joint in joints:
        names = [
            e
            for e in fit.named
            if e.candidate.joint == joint and isinstance(e.candidate.effect, TorqueEffect)
        ]
        words = [e for e in names if not e.is_pattern and e.interval_s == WHOLE]
        curve = {e.candidate.effect.name for e in words} == CURVE
        if not curve and (len(words) != 1 or len(names) == 1):
            continue
        bare = replace(fit, named=tuple(e for e in fit.named if e not in names)).with_noise()
        bare, _ = refitted(bare)
        catalogued = Field(bare, joints, CATALOGUED)
        named = catalogued.together([catalogued.lead_of(e.candidate) for e in words])
        field = Field(bare, joints, PATTERNS)
        patterns = [field.lead_of(c) for c in field.candidates if c.joint == joint]
        best = max(map(field.honest, patterns), key=lambda x: x.chi2)
        if named.chi2 < (CURVE_SHARE if curve else PATTERN_SHARE) * best.chi2:
            fit = _with(bare, Move((best,), best.log_evidence), field.fit.noise) or fit
    return fit


def _alongside(
    fit: Fit, first: Move, moves: Sequence[Move], field: Field, progress: Progress
) -> Fit:
    """With the plain moves of other joints, which do not touch the first one."""
    taken = {first.joint, -1}
    for move in moves:
        if move.joint in taken or move.log_evidence < BELIEF + SURE_NATS:
            continue
        taken.add(move.joint)  # the best move of a joint decides, whatever it is
        if move.plain:
            fit = _with(fit, move, field.fit.noise, progress) or fit
    return fit


def _with(
    fit: Fit, move: Move, rich: Sequence[Noise], progress: Progress = lambda text: None
) -> Fit | None:
    """The model with a move's effects, refitted; None where none pays under its own noise.

    It is fitted under the noise of the richest model first: under its own, an effect that is
    not in yet counts as noise, and would be kept out by itself.
    """
    progress(", ".join(f"{x.candidate.effect.title} {x.candidate.joint + 1}" for x in move.leads))
    before = len(fit.named)
    new = tuple(Named(x.candidate, x.x, x.interval_s, x.recording) for x in move.leads)
    trial, _ = refitted(replace(fit, named=(*fit.named, *new)).with_noise(rich))
    last = len(trial.named) - 1
    if new[-1].interval_s != WHOLE:
        trial = dated(trial, last)
    trial = shaped(trial, last)
    while True:
        trial, carried = under_own_noise(trial)
        bad = _worst(trial, carried, before)
        if bad is None:
            break
        trial = replace(trial, named=trial.named[:bad] + trial.named[bad + 1 :])
        if len(trial.named) == before:
            return None
    return trial if all(e.candidate.effect.possible(e.values) for e in trial.named) else None


def dated(fit: Fit, place: int) -> Fit:
    """A named effect with the start (and end) that the data like best, on a grid of 8 ms.

    All rows count here, those around the dates above all.
    """
    fit = replace(fit, weights=())
    for reach in (0.06, 0.02, 0.008):
        for side in (0, 1):
            centre = fit.named[place].interval_s[side]
            if np.isfinite(centre):
                trials = [_moved(fit, place, side, centre + reach * k) for k in range(-3, 4)]
                fit = min(trials, key=_distance)
        fit, _ = refitted(fit, 1)
    return fit


def _dated_anew(fit: Fit) -> Fit:
    """With the dates of all named effects sought again: one of them has another name now."""
    fit, _ = refitted(fit)
    for k, e in enumerate(fit.named):
        if e.interval_s != WHOLE:
            fit = dated(fit, k)
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
    swaps = 0
    while True:
        fit, carried = under_own_noise(fit)
        bad = _worst(fit, carried)
        if bad is not None:
            fit = replace(fit, named=fit.named[:bad] + fit.named[bad + 1 :])
            continue
        field = Field(fit, joints, CATALOGUED, rich=False)
        standings = tuple(standing(fit, carried, field, k) for k in range(len(fit.named)))
        swapped = _swapped(fit, standings) if swaps < MOST_SWAPS else None
        if swapped is None:
            return Found(fit, carried, standings)
        fit, swaps = _dated_anew(swapped), swaps + 1


def _worst(fit: Fit, carried: Carried, first: int = 0) -> int | None:
    """Of the named effects from `first` on the one that is least worth having, if one is not."""
    values = {}
    for k in range(first, len(fit.named)):
        found, e = worth(fit, carried, k), fit.named[k]
        value = found.log_evidence + price(e)
        if (
            value < BELIEF
            or found.chi2 < CHI2_LEAST
            or not e.candidate.effect.possible(e.values)
            or not pays_held_out(fit, carried, k)
        ):
            values[k] = value
    return min(values, key=values.__getitem__) if values else None


def _swapped(fit: Fit, standings: Sequence[Standing]) -> Fit | None:
    """The model with its worst named effect under a better name, if there is one."""
    best, gain = None, SWAP_NATS
    for k, own in enumerate(standings):
        if isinstance(own.candidate.effect, Pattern):
            continue
        for rival in own.rivals:
            better = own.gain(rival)
            if rival.credible and better > gain:
                best, gain = (k, rival), better
    if best is None:
        return None
    k, rival = best
    other = replace(fit.named[k], candidate=rival.candidate, x=rival.x)
    return replace(fit, named=(*fit.named[:k], other, *fit.named[k + 1 :]))
