"""What is worth trying next: the leads of a scan, in the order in which to try them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from adapter.effects.active import WHOLE
from adapter.effects.base import JOINT, TorqueEffect
from adapter.gap.patterns import Pattern
from adapter.gap.rivals import simpler_wins
from adapter.gap.scan import SUDDEN, Field, Lead

BELIEF = 8.0  # nats that a finding is worth after the price of looking for it
# Fall of the squared distance below which nothing is named: always there, of what does come in
# mid-recording, of what rarely does. Slow noise looks like a small start.
CHI2_LEAST, CHI2_LEAST_SUDDEN, CHI2_LEAST_DATED = 30.0, 90.0, 250.0
BEST_OF_ALL, BEST_OF_JOINT = 6, 4  # leads that are looked at under their own noise
BUNDLE = ("coulomb_friction", "viscous_friction", "torque_offset")  # can hide each other
CHANGE_NATS = 6.0  # by which acting from some time on must beat acting always
CHANGE_SHARE = 0.1  # of the squared distance explained, a nat each: no arm is quite steady


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
    found = [x for x in found if x.chi2 > least_chi2(x.candidate.effect.name, x.interval_s)]
    found = [x for x in found if not any(outdone(x, y) for y in found)]
    moves = [Move((x,), x.log_evidence) for x in found] + _bundles(field, leads, found)
    return sorted(moves, key=lambda x: -x.log_evidence)


def least_chi2(effect: str, interval_s: tuple[float, float]) -> float:
    """What an effect must explain to be named."""
    if interval_s == WHOLE:
        return CHI2_LEAST
    return CHI2_LEAST_SUDDEN if effect in SUDDEN else CHI2_LEAST_DATED


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


def _values(lead: Lead) -> dict[str, Any]:
    return lead.candidate.template.decode(lead.x)
