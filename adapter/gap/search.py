"""The search: one lead after the other, each believed only once it has paid."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from adapter.effects.active import WHOLE
from adapter.effects.base import TorqueEffect
from adapter.gap.adjust import dated, dated_anew, shaped
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, Named, refitted, under_own_noise, worth
from adapter.gap.moves import BELIEF, Move, honest_moves, least_chi2
from adapter.gap.noise import Noise
from adapter.gap.patterns import Pattern
from adapter.gap.rivals import (
    PATTERN_SHARE,
    Standing,
    pays_held_out,
    price,
    standing,
)
from adapter.gap.scan import CATALOGUED, PATTERNS, Field

PATIENCE_S = 35.0  # of processor time, so that load changes no verdict; then nothing more is sought
TRIED = 3  # moves of a round
ROUNDS = 12
CURVE, CURVE_SHARE = {"joint_spring", "torque_ripple"}, 1.1  # one curve over the angle
MOST_SWAPS, SWAP_NATS = 4, 1.0  # names that are exchanged for better ones, and by how much
SURE_NATS = 20.0  # beyond belief: a move that may be taken along with another joint's

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


def search(fit: Fit, joints: Sequence[int], progress: Progress = lambda text: None) -> Found:
    """Name what is missing.

    The catalogue goes first. What is left then may follow a pattern that no effect has; and
    where an effect was named for want of a better word, the pattern takes its place.

    Args:
        fit: the nominal model on the recordings, with any noise model.
        joints: (from 0) that move.
        progress: hears what is being tried.
    """
    begun = time.thread_time()
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
        if not accepted or time.thread_time() - begun > PATIENCE_S:
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
        fit, swaps = dated_anew(swapped), swaps + 1


def _worst(fit: Fit, carried: Carried, first: int = 0) -> int | None:
    """Of the named effects from `first` on the one that is least worth having, if one is not."""
    values = {}
    for k in range(first, len(fit.named)):
        found, e = worth(fit, carried, k), fit.named[k]
        value = found.log_evidence + price(e)
        if (
            value < BELIEF
            or found.chi2 < least_chi2(e.candidate.effect.name, e.interval_s)
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
