"""The search: one lead after the other, each believed only once it has paid."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.base import Effect, TorqueEffect
from adapter.effects.catalogue import HELD
from adapter.effects.law import Law
from adapter.gap.candidates import PATTERN_SHARE, Pattern, is_finer
from adapter.gap.evidence import Carried, Moments, Noise
from adapter.gap.fit import (
    Fit,
    Named,
    dated,
    dated_anew,
    honest_covariance,
    lost_at_once,
    place_of,
    refitted,
    shaped,
    under_own_noise,
    worth,
)
from adapter.gap.folds import pays_held_out, without_each
from adapter.gap.laws import STRIBECK, falling, lawful, left_without
from adapter.gap.real_arm import BRISTLES, COULOMB, start, usually_shaped
from adapter.gap.rivals import Rival, Standing, price, standings
from adapter.gap.scan import (
    BELIEF,
    CATALOGUED,
    PATTERNS,
    Lead,
    Move,
    SignatureTable,
    honest_moves,
    least_chi2,
)
from adapter.judgement.noise import LEAST_NM

ROUNDS = 24  # some seven are made where every joint has friction of its own
MOST_SWAPS = 8  # names that are exchanged for better ones
LOST = 1.2  # times the residual that a simpler name may leave
FAR_NATS = 5.0  # for one of another joint, and for what is rarer than friction and an offset
SAME_TIME_S, DATE_S = 0.5, 1e-3  # between two dates that may be one; within which one stays
# That friction which falls with the speed must say more to be looked at closely, and that bristles
# must be better than friction that slides at once.
TWO_SIGMA_CHI2 = 4.0

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Found:
    """What a search ended with.

    Attributes:
        fit: the model, under its own noise; carried: what is known of its coefficients.
        standings: of each named effect among its rivals.
        weak: places of named effects that any arm has and these data do not single out.
        known: what is known of them with the inertias free within their prior, where `carried`
            holds these fast.
        under: the fit whose noise and prior `carried` is of, where these are not those of `fit`.
        rounds: that were made; ran_out: and there was none left where one was wanted.
    """

    fit: Fit
    carried: Carried | Moments
    standings: tuple[Standing, ...]
    known: Carried | Moments | None = None
    under: Fit | None = None
    weak: frozenset[int] = frozenset()
    rounds: int = 0
    ran_out: bool = False


@dataclass
class Budget:
    """Rounds that a search may make. Counted, not timed: no verdict hangs on a machine's speed.

    Attributes:
        rounds: in all; made: so far; ran_out: whether one was wanted when none was left.
    """

    rounds: int
    made: int = 0
    ran_out: bool = False

    def spend(self) -> bool:
        """Whether one more round may be made."""
        self.ran_out = self.made >= self.rounds
        self.made += not self.ran_out
        return not self.ran_out


def search(
    fit: Fit, joints: Sequence[int], rounds: int = ROUNDS, progress: Progress = lambda text: None
) -> Found:
    """Name what is missing.

    The catalogue goes first. What is left then may follow a pattern that no effect has; and
    where an effect was named for want of a better word, the pattern takes its place.

    Args:
        fit: the nominal model on the recordings, with any noise model.
        joints: (from 0) that move.
        rounds: that may be made, each with the best of what is worth naming.
        progress: hears what is being tried.
    """
    budget = Budget(rounds)
    progress("a load at the hand")
    fit = settled(_extended(start(fit, joints), joints, CATALOGUED, budget, progress), joints).fit
    # noise that was taken for the first effect's may have hidden another one
    fit = _extended(fit, joints, CATALOGUED, budget, progress)
    fit = _extended(fit, joints, PATTERNS, budget, progress)
    found = settled(_renamed(fit, joints), joints)
    fit = _falling(found)
    found = found if fit is found.fit else settled(fit, joints)
    progress("laws of what no effect explains")
    fit = lawful(found.fit)
    if fit is not found.fit:
        lawless = left_without(found.fit, (judged := settled(fit, joints)).fit)
        found = settled(lawful(found.fit, lawless), joints) if lawless else judged
    found = _as_resolved(found)
    return replace(found, rounds=budget.made, ran_out=budget.ran_out)


def _falling(found: Found) -> Fit:
    """With friction that falls with the speed, on joints where all that is left has a name."""
    fit, patterns = found.fit, {e.candidate.joint for e in found.fit.named if e.is_pattern}
    for own in found.standings:
        key, asked = (STRIBECK.name, own.candidate.joint), own.chi2 + TWO_SIGMA_CHI2
        more = any(x.candidate.key == key and x.is_alike and x.chi2 > asked for x in own.rivals)
        if own.candidate.effect is BRISTLES and more and key[1] not in patterns:
            fit = falling(fit, key[1])
    return fit


def _extended(
    fit: Fit, joints: Sequence[int], kind: str, budget: Budget, progress: Progress
) -> Fit:
    """With all that pays of one kind of candidates."""
    refused: set[tuple[str, int]] = set()
    more = True
    while more and budget.spend():
        fit, more = _round(fit, joints, kind, refused, progress)
    return fit


def _round(
    fit: Fit, joints: Sequence[int], kind: str, refused: set[tuple[str, int]], progress: Progress
) -> tuple[Fit, bool]:
    """With the best of what pays, and whether more may be found; the rest joins `refused`."""
    table = SignatureTable(fit, joints, kind)
    fit = table.fit
    # a hand may pick up and put down as often as it likes, and what any arm has may change
    once = (e for e in fit.named if not (e.assumed or e.candidate.effect is HELD))
    moves = honest_moves(table, refused | {e.candidate.key for e in once})
    there = [e for e in fit.named if e.assumed]
    moves = [
        move
        for move in moves
        if not any(not x.limits and any(e.covers(x.candidate) for e in there) for x in move.leads)
    ]
    for move in moves[:3]:  # moves of a round
        again = _dated_anew_beside(fit, move)
        if again is not None:
            return again, True
        trial = _with(fit, move, table.fit.noise, progress)
        if trial is not None:
            taken = {move.joint, -1}  # plain moves of other joints do not touch this one
            for other in moves:
                if other.joint in taken or other.log_evidence < BELIEF + 20.0:  # or less sure
                    continue
                taken.add(other.joint)  # the best move of a joint decides, whatever it is
                if other.plain:
                    trial = _with(trial, other, table.fit.noise, progress) or trial
            return trial, True
        refused.update(x.candidate.key for x in move.leads if len(move.leads) == 1)
    return fit, False


def _dated_anew_beside(fit: Fit, move: Move) -> Fit | None:
    """With its dates sought again, where one is near that of a move; None where none changes.

    A date that is wrong by some samples looks like something else that begins then.
    """
    edges = [t for x in move.leads for t in x.interval_s if np.isfinite(t)]
    if not any(abs(t - s) < SAME_TIME_S for t in edges for e in fit.named for s in e.interval_s):
        return None
    again = dated_anew(fit)
    pairs = zip(again.named, fit.named, strict=True)
    moved = any(not np.allclose(a.interval_s, b.interval_s, atol=DATE_S) for a, b in pairs)
    return again if moved else None


def _renamed(fit: Fit, joints: Sequence[int]) -> Fit:
    """Patterns in place of effects that explain clearly less than a pattern does alone.

    A spring and a ripple on one joint are two words for one curve over the angle; a pattern
    need not explain more than both together.
    """
    for joint in joints:
        names = [
            e
            for e in fit.named
            if e.candidate.joint == joint
            and isinstance(e.candidate.effect, TorqueEffect)
            and not e.assumed
        ]
        words = [e for e in names if not e.is_curve and e.interval_s == WHOLE]
        curve = len({e.candidate.effect.name for e in words if e.candidate.effect.over_angle}) > 1
        curve = curve and all(e.candidate.effect.over_angle for e in words)
        if not curve and (len(words) != 1 or len(names) == 1):
            continue
        if any(isinstance(e.candidate.effect, Law) for e in names):  # its place is told next
            continue
        bare = fit.with_named([e for e in fit.named if e not in names]).with_noise()
        bare, _ = refitted(bare)
        catalogued = SignatureTable(bare, joints, CATALOGUED)
        named = catalogued.together([catalogued.lead_of(e.candidate) for e in words])
        table = SignatureTable(bare, joints, PATTERNS)
        own = [c for c in table.candidates if c.joint == joint and isinstance(c.effect, Pattern)]
        patterns = [table.lead_of(c) for c in own]
        best = max(map(table.honest, patterns), key=lambda x: x.chi2)
        if named.chi2 < (1.1 if curve else PATTERN_SHARE) * best.chi2:  # two words for one curve
            fit = _with(bare, Move((best,), best.log_evidence), table.fit.noise) or fit
    return fit


def _with(
    fit: Fit, move: Move, rich: Sequence[Noise], progress: Progress = lambda text: None
) -> Fit | None:
    """The model with a move's effects, refitted; None where none pays under its own noise.

    It is fitted under the noise of the richest model first: under its own, an effect that is
    not in yet counts as noise, and would be kept out by itself.
    """
    progress(", ".join(f"{x.candidate.effect.title} {x.candidate.joint + 1}" for x in move.leads))
    before, lead = len(fit.named), move.leads[-1]
    new = [Named(x.candidate, x.x, x.interval_s, x.recording) for x in move.leads]
    known = [*(a.effect for a in fit.model.known), *(e.candidate.effect for e in fit.named)]
    if _puts_down(lead) and HELD not in known:  # then the hand held it before
        new.insert(0, Named(lead.candidate, np.zeros(len(lead.x)), recording=lead.recording))
    trial, _ = refitted(fit.with_named((*fit.named, *new)).with_noise(rich))
    last = len(trial.named) - 1
    if new[-1].interval_s != WHOLE:
        trial = dated(trial, last)
    trial = shaped(trial, last)
    while True:
        trial, carried = under_own_noise(trial)
        bad = worst(trial, weak(trial, carried, before))
        if bad is None:  # what no arm has beside the new ones: it is found again by a better name
            old = enumerate(trial.named[:before])
            bad = next((k for k, e in old if not (e.assumed or e.possible)), None)
        if bad is None:
            return trial
        trial, before = trial.without(bad), before - (bad < before)
        if len(trial.named) == before:
            return None


def _puts_down(e: Named | Lead) -> bool:
    """Whether the hand carries less from some time on."""
    return e.candidate.effect is HELD and bool(np.isfinite(e.interval_s[0]) and e.x[0] < 0.0)


def settled(fit: Fit, joints: Sequence[int]) -> Found:
    """Without what no longer pays beside the others, each by its best name, under its own noise.

    What gave way beside other effects than there are now is a name once more.
    """
    fit = usually_shaped(fit.with_named([replace(e, tried=frozenset()) for e in fit.named]))
    swaps, before = 0, None  # the fit before names were exchanged, until that is judged
    while True:
        fit, carried = under_own_noise(fit)
        if before is not None and _lost(before, fit):
            for k, (a, b) in enumerate(zip(before.named, fit.named, strict=True)):
                if a.candidate is not b.candidate:  # that it got instead has been tried
                    before = before.instead(k, replace(a, tried=a.tried | {b.candidate.key}))
            fit, before = before, None
            continue
        before, values = None, weak(fit, carried)
        bad = worst(fit, values)
        if bad is not None:
            gone, fit = fit.named[bad].candidate, fit.without(bad)
            for k, e in enumerate(fit.named):  # beside it one of its form explained the rest alone
                alike = e.candidate.joint == gone.joint
                if alike and gone.effect.form and e.candidate.effect.form == gone.effect.form:
                    fit = shaped(refitted(fit)[0], k)
            continue
        ranked = standings(fit, carried, SignatureTable(fit, joints, CATALOGUED, rich=False))
        swapped = _swapped(fit, ranked, values) if swaps < MOST_SWAPS else None
        if swapped is None:
            return Found(fit, carried, ranked, weak=frozenset(values))
        before, fit, swaps = fit, dated_anew(swapped), swaps + 1


def _as_resolved(found: Found) -> Found:
    """Bristles over a way that these data do not tell from none are told as Coulomb friction.

    The model keeps them: they know what a joint that rests holds.
    """
    fit, standings = found.fit, list(found.standings)
    carried = fit.carried()
    for k, e in enumerate(fit.named):
        if e.candidate.effect is not BRISTLES or k in found.weak:
            continue
        if lost_at_once(fit, carried, k) + 2.0 * BRISTLES.log_odds_of(e.values) < TWO_SIGMA_CHI2:
            told = replace(e.candidate, effect=COULOMB)
            rivals = tuple(r for r in standings[k].rivals if r.candidate.key != told.key)
            standings[k] = replace(standings[k], candidate=told, rivals=rivals)
    return replace(found, standings=tuple(standings))


def _lost(before: Fit, fit: Fit) -> bool:
    """Whether other names explain less, or far less of a joint's torque where they are simpler."""
    if len(before.named) != len(fit.named):
        return False
    a, b = (
        np.sqrt(np.mean(np.concatenate(own.model.residuals()) ** 2, axis=0))
        for own in (before, fit)
    )
    more = np.log(np.maximum(b, LEAST_NM) / np.maximum(a, LEAST_NM))
    pairs = zip(before.named, fit.named, strict=True)
    simpler = any(
        is_finer(x.candidate, y.candidate) for x, y in pairs if x.candidate.key != y.candidate.key
    )
    return bool((more > np.log(LOST)).any() or (more.sum() > 0.0 and not simpler))


def worst(fit: Fit, values: Mapping[int, float]) -> int | None:
    """Of the effects that are `weak` the one that is least worth having.

    What any arm has stays, unless no arm has it so.
    """
    losing = [k for k in values if not (fit.named[k].assumed and fit.named[k].possible)]
    return min(losing, key=values.__getitem__, default=None)


def weak(fit: Fit, carried: Carried, first: int = 0) -> dict[int, float]:
    """Places of named effects from `first` on that are not worth a name, and their nats."""
    values, others = {}, without_each(fit, carried)
    for k in range(first, len(fit.named)):
        found, e = worth(fit, carried, k), fit.named[k]
        limited = (e.recording is not None or e.interval_s != WHOLE) and not from_the_start(e)
        value = found.log_evidence + price(e) + e.candidate.effect.log_odds_of(e.values)
        if from_the_start(e) and e.possible and any(map(_puts_down, fit.named)):
            continue  # the hand held what it puts down
        if (
            value < BELIEF
            or found.chi2 < least_chi2(e.candidate.effect, limited)
            or not e.possible
            or (e.candidate.effect.passing and not _stands_out(fit, carried, k))
            or not (from_the_start(e) or pays_held_out(fit, carried, others, k))
        ):
            values[k] = value
    return values


def _is_common(effect: Effect) -> bool:
    """Whether any joint may well have it: friction, an offset."""
    return effect.bundled or (bool(effect.form) and isinstance(effect, TorqueEffect))


def from_the_start(e: Named | Lead) -> bool:
    """Whether it is a load from the first sample on.

    Nothing is commoner, and what looks like one is called one: heavier links and rarer effects
    could stand for it, each at a price that the evidence has asked for.
    """
    return e.candidate.effect is HELD and e.interval_s == WHOLE


def _stands_out(fit: Fit, carried: Carried, k: int) -> bool:
    """Whether the force of what pushes is clearly above its doubt, and is no weight.

    What never comes nor goes is weight, unless most of it points another way than down.
    """
    own = place_of(fit, k)[:3]
    force, doubt = fit.coefficients[own], honest_covariance(fit, carried)[np.ix_(own, own)]
    if fit.named[k].interval_s == WHOLE:
        gravity = fit.model.arm.gravity
        down = gravity / max(float(np.linalg.norm(gravity)), 1e-9)  # m/s², least gravity
        aside = force - (force @ down) * down
        if aside @ aside < (force @ down) ** 2:
            return False
        force = aside
    square = float(force @ force)
    return square**2 > 3.0**2 * float(force @ doubt @ force)  # standard deviations


def _swapped(fit: Fit, standings: Sequence[Standing], unnamed: Container[int]) -> Fit | None:
    """The model with the worst named effect of each joint under a better name, if there is one.

    What is not of one joint goes alone; what any arm has and is `unnamed` stays.
    """
    best: dict[int, tuple[float, int, Rival]] = {}
    for k, own in enumerate(standings):
        pattern = isinstance(own.candidate.effect, Pattern)
        if pattern or k in unnamed or from_the_start(fit.named[k]):
            continue
        for rival in own.rivals:
            better, joint = own.gain(rival), own.candidate.joint
            asked = 0.0
            if joint != rival.candidate.joint:
                joint, asked = -1, FAR_NATS
            elif _is_common(own.candidate.effect) and not _is_common(rival.candidate.effect):
                asked = FAR_NATS
            better_than = max(asked, best.get(joint, (asked,))[0])
            again = rival.candidate.key in fit.named[k].tried
            if rival.is_alike and rival.credible and not again and better > better_than:
                best[joint] = better, k, rival
    if not best:
        return None
    first = max(best, key=lambda joint: best[joint][0])
    together = [joint for joint in best if joint >= 0] if first >= 0 else [first]
    for joint in together:
        _, k, rival = best[joint]
        named = fit.named[k]
        tried = named.tried | {named.candidate.key}
        other = replace(named, candidate=rival.candidate, x=rival.x, assumed=False, tried=tried)
        fit = shaped(fit.instead(k, other), k)
    return fit
