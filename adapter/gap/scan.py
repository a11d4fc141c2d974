"""Looking for the next effect: every template, in every joint, at all times or from some time on.

Times are scanned in blocks through running sums of the products, so that a start costs no more
than a small solve.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from adapter.effects.active import WHOLE
from adapter.effects.base import JOINT, Effect, Template, TorqueEffect
from adapter.effects.law import Law
from adapter.gap.candidates import (
    Candidate,
    Pattern,
    laws,
    line,
    line_hz,
    log_odds,
    patterns,
    sharpened,
    signatures,
    simpler_wins,
)
from adapter.gap.evidence import BAND_HZ, Carried, Noise, Score, quiet_noise, score, scores
from adapter.gap.fit import Fit
from adapter.judgement.noise import LEAST_NM
from adapter.model.spatial import Array

CATALOGUED, PATTERNS, FORMS = "catalogued", "patterns", "forms"
BLOCK_S, DATE_STEP_S = 0.4, 0.04
SUDDEN_S = 0.1  # the same of what comes at once: a moment without it may say more than seconds with
UNSURE_S = 0.16  # a date is not known better before the effect is refitted
AT_ONCE = 24  # candidates of a long recording
LONGEST_CONTACT_S = 8.0


BELIEF = 8.0  # nats that a finding is worth after the price of looking for it
# Fall of the squared distance below which nothing is named: always there, of what does come in
# mid-recording, of what rarely does. Slow noise looks like a small start.
CHI2_LEAST, CHI2_LEAST_SUDDEN, CHI2_LEAST_DATED = 30.0, 90.0, 250.0
QUIETER = 0.3  # of that: what may be far more under its own noise
BEST_OF_ALL, BEST_OF_JOINT = 6, 4  # leads that are looked at under their own noise
CHANGE_NATS = 6.0  # by which acting from some time on must beat acting always
CHANGE_SHARE = 0.1  # of the squared distance explained, a nat each: no arm is quite steady


@dataclass(frozen=True, eq=False)
class Lead:
    """A candidate with its evidence.

    Attributes:
        candidate: what and where.
        log_evidence: nats over nothing, its odds and the number of ways to look included.
        chi2: fall of the squared distance.
        x: (k,) coefficients.
        interval_s, recording: when and where it acts.
        odds: the part of the evidence that is older than the data.
    """

    candidate: Candidate
    log_evidence: float
    chi2: float
    x: Array
    interval_s: tuple[float, float] = WHOLE
    recording: int | None = None
    odds: float = 0.0

    @property
    def limits(self) -> int:
        """How often it is limited: to one recording, and to a time of it."""
        return (self.recording is not None) + (self.interval_s != WHOLE)


def rich_noise(X: Array, candidates: Sequence[Candidate], residual: Array, weight: Array) -> Noise:
    """Noise of a residual (k, n) without what all signatures X (c, k, n) at once explain of it.

    Args:
        weight: (k, n) of its rows: nothing where a joint rests, and holds what it likes.
    """
    prior = np.zeros(len(X))
    for c in candidates:
        # patterns and laws are so many that they would explain noise, but for a line
        if not isinstance(c.effect, Pattern | Law) or c.effect.name.endswith("Hz"):
            k = list(c.columns)
            prior[k] = np.maximum(prior[k], c.prior_std)
    used, x = np.flatnonzero(prior > 0.0), np.zeros(len(X))
    # of the residual that may be noise, for a start
    sigma = 0.2 * quiet_noise(residual, weight).level + LEAST_NM
    white, data = X[used], (residual * weight / sigma).ravel()
    white *= weight / sigma
    white = white.reshape(len(used), -1)
    for _ in range(2):
        information = white @ white.T
        information[np.diag_indices(len(used))] += prior[used] ** -2.0
        x[used] = cho_solve(cho_factor(information, lower=True), white @ data)
        noise = quiet_noise(residual - np.tensordot(x, X, 1), weight)
        # some at a time into what is there: tables of a long recording are large
        data = (weight * noise.whiten(residual)).ravel()
        for first in range(0, len(used), AT_ONCE):
            some = used[first : first + AT_ONCE]
            part = (weight * noise.whiten(X[some])).reshape(len(some), -1)
            white[first : first + AT_ONCE] = part
    return noise


class SignatureTable:
    """All signatures of the recordings about the present model, white.

    The noise that whitens them is what the richest model of all leaves: whatever the catalogue
    can explain is taken out, the more so as nobody knows yet what it is. That is too little to
    believe a lead by, and right to find one.

    Args:
        fit: the model as it stands; joints: (from 0) that move.
        kind: of the candidates: `CATALOGUED`, with laws for rivals; `PATTERNS` and laws; `FORMS`,
            laws alone.
        rich: whiten by that noise; by the fit's own where False.
    """

    def __init__(
        self, fit: Fit, joints: Sequence[int], kind: str = CATALOGUED, rich: bool = True
    ) -> None:
        tables, noise = [], []
        extra = self._patterns(fit, joints) if kind == PATTERNS else []
        stages = [fit.model.stages(i) for i in range(len(fit.recordings))]
        lawful = list(joints)
        if kind == CATALOGUED:  # those that have a law, or an effect that one may be taken for
            named = [e.candidate for e in fit.named if not e.assumed]
            rivalled = [c.joint for c in named if isinstance(c.effect, Law) or c.effect.over_angle]
            lawful = sorted({*rivalled} & {*joints})
        extra += [way for j in lawful for way in laws(stages, j)]
        self.candidates: list[Candidate] = []
        for i in range(len(fit.recordings)):
            table, self.candidates = signatures(stages[i], joints, extra, fit.model.hand)
            tables.append(table)
            if rich:
                weight = fit.recordings[i].sliding * fit.weights[i]
                noise.append(rich_noise(table, self.candidates, fit.model.residual(i), weight))
        if kind != CATALOGUED:
            self.candidates = [c for c in self.candidates if isinstance(c.effect, Pattern | Law)]
        self.fit = fit.with_noise(noise) if rich else fit
        self.tables = tables
        self.carried_tables = [self.fit.model.signatures(i) for i in range(len(tables))]
        self.carried = self.fit.carried()
        self.targets = [
            r + np.tensordot(self.fit.coefficients, c, 1)
            for r, c in zip(self.fit.model.residuals(), self.carried_tables, strict=True)
        ]
        self.times = [r.t for r in fit.recordings]

    @cached_property
    def X(self) -> Array:
        """(c, r) all signatures, white."""
        return self.fit.whiten(self.tables)

    def _patterns(self, fit: Fit, joints: Sequence[int]) -> list[tuple[Effect, int, Template]]:
        """Patterns of each joint, and lines in time."""
        found: list[tuple[Effect, int, Template]] = [
            (p, j, p.templates()[0]) for j in joints for p in patterns(j)
        ]
        residuals = fit.model.residuals()
        i = int(np.argmax([len(x) for x in residuals]))
        own, residual = fit.recordings[i], residuals[i]
        begin, end = max(pairwise([*own.seams, len(residual)]), key=lambda x: x[1] - x[0])
        for j in joints:
            hz = line_hz(residual[begin:end, j], BAND_HZ)
            if hz is not None:
                if end - begin < len(residual):
                    hz = sharpened(hz, residual[:, j], own.t, BAND_HZ / (end - begin))
                found.append((line(hz), j, line(hz).templates()[0]))
        return found

    def gated(self, lead: Lead) -> list[Array]:
        """Signatures (c, k, n) of a lead in each recording, in its interval alone."""
        return self.within(lead.interval_s, lead.recording, list(lead.candidate.columns))

    def within(
        self, interval_s: tuple[float, float], recording: int | None, columns: Any = slice(None)
    ) -> list[Array]:
        """Signatures (c, k, n) of each recording, zero outside an interval."""
        if interval_s == WHOLE and recording is None:
            return [table[columns] for table in self.tables]
        out = []
        for i, (table, own) in enumerate(zip(self.tables, self.fit.recordings, strict=True)):
            on = (own.t >= interval_s[0]) & (own.t < interval_s[1])
            if recording not in (None, i):
                on[:] = False
            out.append(table[columns] * on[:, None])
        return out

    def honest(self, lead: Lead) -> Lead:
        """A lead under the noise that it leaves itself, in place of that of the richest model."""
        lead = self.dated(lead)
        found = self.together([lead])
        nats = found.log_evidence + lead.odds
        return replace(lead, log_evidence=nats, chi2=found.chi2, x=found.x)

    def dated(self, lead: Lead) -> Lead:
        """A lead with the dates that its evidence likes best, to a sample of the band."""
        for side in (0, 1):
            if np.isfinite(lead.interval_s[side]):
                around = np.arange(-BLOCK_S, BLOCK_S + 0.5 * DATE_STEP_S, DATE_STEP_S)
                trials = [self._with_edge(lead, side, lead.interval_s[side] + x) for x in around]
                lead = max(trials, key=lambda x: x.chi2)
        return lead

    def _with_edge(self, lead: Lead, side: int, t: float) -> Lead:
        """A lead with another date, and what it explains then."""
        interval = (t, lead.interval_s[1]) if side == 0 else (lead.interval_s[0], t)
        lead = replace(lead, interval_s=interval)
        if interval[1] <= interval[0]:
            return replace(lead, chi2=-np.inf)
        X = self.fit.whiten(self.gated(lead))
        found = score(*self.carried.without(X), lead.candidate.prior_std)
        return replace(lead, chi2=found.chi2)

    def together(self, leads: Sequence[Lead]) -> Score:
        """Several leads at once under the noise that they leave, without their odds."""
        parts = [self.gated(lead) for lead in leads]
        tables = [np.concatenate(x) for x in zip(*parts, strict=True)]
        own_std = np.concatenate([lead.candidate.prior_std for lead in leads])
        fit, base = replace(self.fit, doubts=self._undated(leads)), self.carried
        if any(lead.interval_s != WHOLE for lead in leads):  # other rows count than in the table
            base = self._carried_under(fit)
        left = self._left(fit, base, tables, own_std)
        # what other joints lack counts for nothing in the richest noise, and pulls at all of them
        fit = replace(fit, noise=fit.noise_of(left))
        left = self._left(fit, self._carried_under(fit), tables, own_std)
        fit = replace(fit, noise=fit.noise_of(left))
        return score(*self._carried_under(fit).without(fit.whiten(tables)), own_std)

    def _carried_under(self, fit: Fit) -> Carried:
        """What is carried along, under the noise and the weights of a fit."""
        return Carried(fit.whiten(self.carried_tables), fit.prior_std, fit.whiten(self.targets))

    def _left(
        self, fit: Fit, base: Carried, tables: Sequence[Array], own_std: Array
    ) -> list[Array]:
        """(k, n) of each recording: what further signatures `tables` and the carried ones leave."""
        X = fit.whiten(tables)
        C = X @ base.N.T
        own = score(*base.reduced(X @ X.T, C, X @ base.data), own_std).x
        carried = base.x - own @ base.solved(C)
        return [
            target - np.tensordot(carried, N, 1) - np.tensordot(own, table, 1)
            for target, N, table in zip(self.targets, self.carried_tables, tables, strict=True)
        ]

    def _undated(self, leads: Sequence[Lead]) -> tuple[Array, ...]:
        """Doubts (k, n) of the rows: infinite where a lead's start is not known well enough yet."""
        out = []
        for i, own in enumerate(self.fit.recordings):
            doubt = self.fit.doubts[i].copy() if self.fit.doubts else np.zeros_like(own.tau)
            for lead in leads:
                for edge in lead.interval_s if lead.recording in (None, i) else ():
                    near = (own.t > edge - UNSURE_S) & (own.t < edge + UNSURE_S)
                    doubt[near] = np.inf
            out.append(doubt)
        return tuple(out)

    def lead_of(self, candidate: Candidate) -> Lead:
        """A candidate, acting all the time, of which nothing is known yet."""
        alike = [c for c in self.candidates if c.key == candidate.key]
        same = [c for c in alike if c.template.label == candidate.template.label]
        own = (same or alike)[0]
        return Lead(own, 0.0, 0.0, np.zeros(len(own.columns)), odds=log_odds(own))

    def whole(self) -> list[Lead]:
        """Every candidate, acting all the time."""
        leads = []
        C = self.X @ self.carried.N.T
        solved = self.carried.solved(C)
        g = self.X @ self.carried.data - solved @ self.carried.g
        for c in self.candidates:
            k = list(c.columns)
            G = self.X[k] @ self.X[k].T - solved[k] @ C[k].T
            found, odds = score(G, g[k], c.prior_std), log_odds(c)
            leads.append(Lead(c, found.log_evidence + odds, found.chi2, found.x, odds=odds))
        return leads

    def timed(self, candidates: Sequence[Candidate]) -> list[Lead]:
        """The best start of each candidate in each recording."""
        leads = []
        for i, t in enumerate(self.times):
            for sudden, block_s in ((True, SUDDEN_S), (False, BLOCK_S)):
                edges = _edges(t, block_s)
                # a start near either end is no change
                inside = (edges > t[0] + 2.0 * BLOCK_S) & (edges < t[-1] - 2.0 * BLOCK_S)
                pairs = [(int(a), len(edges) - 1) for a in np.flatnonzero(inside)]
                own = [c for c in candidates if c.effect.sudden is sudden]
                leads += self._best_intervals(i, own, edges, pairs)
        return leads

    def apart(self, candidates: Sequence[Candidate]) -> list[Lead]:
        """Each candidate in the whole of one of several recordings, and in no other."""
        leads: list[Lead] = []
        for i, t in enumerate(self.times if len(self.times) > 1 else ()):
            leads += self._best_intervals(i, candidates, t[[0, -1]] + (0.0, 1.0), [(0, 1)])
        return [replace(lead, interval_s=WHOLE) for lead in leads]

    def passing(self, candidates: Sequence[Candidate]) -> list[Lead]:
        """The best interval of each candidate inside each recording: it comes and goes."""
        leads = []
        longest = round(LONGEST_CONTACT_S / BLOCK_S)
        for i, t in enumerate(self.times):
            edges = _edges(t, BLOCK_S)
            last = len(edges) - 1
            ends = [(a, min(a + longest, last - 1)) for a in range(1, last)]
            pairs = [(a, b) for a, end in ends for b in range(a + 1, end + 1)]
            # no push lasts for what was left out between two stretches
            pairs = [(a, b) for a, b in pairs if edges[b] - edges[a] < LONGEST_CONTACT_S + BLOCK_S]
            leads += self._best_intervals(i, candidates, edges, pairs, passing=True)
        return leads

    def _best_intervals(
        self,
        recording: int,
        candidates: Sequence[Candidate],
        edges: Array,
        pairs: Sequence[tuple[int, int]],
        passing: bool = False,
    ) -> list[Lead]:
        """Of each candidate the best of the intervals between pairs of a recording's edges."""
        if not (pairs and candidates):
            return []
        (first, last), leads = np.array(pairs).T, []
        for c, sums in zip(candidates, self._running(recording, candidates, edges), strict=True):
            reduced = self.carried.reduced(*(x[first] - x[last] for x in sums))
            evidences, chi2, x = scores(*reduced, c.prior_std)
            best = int(np.argmax(evidences))
            odds = log_odds(c, timed=not passing, passing=passing) - float(np.log(len(pairs)))
            when = (float(edges[first[best]]), float(edges[last[best]]) if passing else np.inf)
            worth = float(evidences[best]) + odds
            leads.append(Lead(c, worth, float(chi2[best]), x[best], when, recording, odds))
        return leads

    def _running(
        self, recording: int, candidates: Sequence[Candidate], edges: Array
    ) -> Iterator[tuple[Array, Array, Array]]:
        """Of each candidate sums from each edge to the end of its products.

        Yields:
            with itself (b, k, k), with the carried signatures (b, k, c), with the data (b, k).
        """
        if len(self.fit.recordings[recording].begins) > 1 and len(candidates) > AT_ONCE:
            for first in range(0, len(candidates), AT_ONCE):  # all at once take much memory
                yield from self._running(recording, candidates[first : first + AT_ONCE], edges)
            return
        t, n = self.times[recording], self.fit.n
        begin = sum(len(x) for x in self.times[:recording]) * n
        rows = slice(begin, begin + len(t) * n)
        block = np.repeat(np.searchsorted(edges, t, side="right") - 1, n)
        cuts = np.searchsorted(block, np.arange(len(edges)))
        parts = [slice(a, b) for a, b in pairwise(cuts)]
        columns = sorted({k for c in candidates for k in c.columns})
        X, data = self.X[columns, rows], self.carried.data[rows]
        N = self.carried.N[:, rows]
        right = np.vstack([N, data])
        whole = _from_the_end([X[:, part] @ right[:, part].T for part in parts])
        place = {k: at for at, k in enumerate(columns)}
        for c in candidates:
            at = [place[k] for k in c.columns]
            own = _from_the_end([X[at, part] @ X[at, part].T for part in parts])
            yield own, whole[:, at, :-1], whole[:, at, -1]


def _edges(t: Array, block_s: float) -> Array:
    """(b,) edges of the blocks of a recording's instants, the last one behind its end.

    Where time is left out, the block before lasts all that time.
    """
    cuts = np.flatnonzero(np.diff(t) > BLOCK_S)
    begins, ends = t[np.append(0, cuts + 1)], t[np.append(cuts, len(t) - 1)]
    parts = [np.arange(a, b, block_s) for a, b in zip(begins, ends, strict=True)]
    return np.append(np.concatenate(parts), t[-1] + 1.0)


def _from_the_end(parts: Sequence[Array]) -> Array:
    """(b + 1, ...) sums of the parts from each of b on, and nothing behind the last."""
    table = np.array([*parts, np.zeros_like(parts[0])])
    return np.asarray(np.cumsum(table[::-1], axis=0)[::-1])


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


def leads_of(table: SignatureTable) -> list[Lead]:
    """The best leads first, no two of one effect on one joint and of one kind of interval."""
    best: dict[tuple[str, int, str], Lead] = {}
    always: dict[tuple[str, int, str], Lead] = {}
    for lead in table.whole():
        _keep(always, lead, "whole")
        if lead.candidate.possible(lead.x, WHOLE):
            _keep(best, lead, "whole")
    # a pattern may change in mid-recording as well, but then it is a pattern all the more
    chosen = [x.candidate for x in always.values() if not isinstance(x.candidate.effect, Pattern)]
    timed = table.timed([c for c in chosen if not c.effect.steady])
    apart = [c for c in chosen if not c.effect.steady or isinstance(c.effect, Law)]
    for lead in (*table.apart(apart), *timed):
        if lead.candidate.possible(lead.x, lead.interval_s):
            _keep(best, lead, "timed" if lead.limits > 1 else "apart")
    for lead in table.passing([c for c in chosen if c.effect.passing]):
        _keep(best, lead, "passing")
    return sorted(best.values(), key=lambda lead: -lead.log_evidence)


def honest_moves(table: SignatureTable, refused: set[tuple[str, int]]) -> list[Move]:
    """What is worth trying, under its own noise, in the order in which to try it.

    What is simpler goes first: always before from some time on, an effect before its finer
    form, unless the other explains clearly more. Friction and an offset can hide each other:
    they are also tried together.
    """
    leads = [x for x in leads_of(table) if x.candidate.key not in refused]
    found = [x for x in map(table.honest, _shortlist(leads)) if x.log_evidence > BELIEF]
    found = [x for x in found if x.chi2 > least_chi2(x.candidate.effect, x.limits > 0)]
    found = [x for x in found if not any(outdone(x, y) for y in found)]
    moves = [Move((x,), x.log_evidence) for x in found] + _bundles(table, leads, found)
    return sorted(moves, key=lambda x: -x.log_evidence)


def least_chi2(effect: Effect, limited: bool) -> float:
    """What an effect must explain to be named, the more where it is not always there."""
    if not limited:
        return CHI2_LEAST
    return CHI2_LEAST_SUDDEN if effect.sudden else CHI2_LEAST_DATED


def _shortlist(leads: Sequence[Lead]) -> list[Lead]:
    """The best leads of each joint and the best of all.

    Noise is still what they explain as well: under its own, one may be worth far more, above all
    one of those that the richest model of all does not have.
    """
    seen: dict[int, int] = {}
    chosen = []
    for place, lead in enumerate(leads):
        lawless = not isinstance(lead.candidate.effect, Pattern | Law)
        if lead.log_evidence < 0.0 and (lawless or lead.chi2 < QUIETER * CHI2_LEAST):
            continue
        joint = lead.candidate.joint
        plain = lead.candidate.effect.bundled and not lead.limits
        if plain or place < BEST_OF_ALL or seen.get(joint, 0) < BEST_OF_JOINT:
            chosen.append(lead)
            seen[joint] = seen.get(joint, 0) + 1
    return chosen


def _bundles(table: SignatureTable, leads: Sequence[Lead], found: Sequence[Lead]) -> list[Move]:
    """What any joint may have, on each joint where it says more together than one of it alone."""
    moves = []
    for joint in {x.candidate.joint for x in leads}:
        own: dict[str, Lead] = {}  # of one thing in several forms the best
        for x in leads:
            effect = x.candidate.effect
            if x.candidate.joint == joint and effect.bundled and not x.limits:
                own.setdefault(effect.form or effect.name, x)
        if len(own) < 2 or max(x.log_evidence for x in own.values()) < BELIEF:
            continue
        bundle = tuple(own.values())
        worth_it = table.together(bundle).log_evidence + sum(x.odds for x in bundle)
        alone = max((x.log_evidence for x in found if x.candidate.joint == joint), default=BELIEF)
        if worth_it > alone + BELIEF:
            moves.append(Move(bundle, worth_it))
    return moves


def outdone(lead: Lead, by: Lead) -> bool:
    """Whether a simpler lead says all but the same."""
    a, b = lead.candidate, by.candidate
    if lead is by:
        return False
    if a.key == b.key:
        more = lead.limits > by.limits
        return more and lead.log_evidence < by.log_evidence + CHANGE_NATS + CHANGE_SHARE * by.chi2
    return simpler_wins((b, by.chi2), (a, lead.chi2))


def _keep(best: dict[tuple[str, int, str], Lead], lead: Lead, kind: str) -> None:
    key = (*lead.candidate.key, kind)
    if key not in best or lead.log_evidence > best[key].log_evidence:
        best[key] = lead
