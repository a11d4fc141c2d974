"""Looking for the next effect: every template, in every joint, at all times or from some time on.

Times are scanned in blocks of 0.4 s through running sums of the products, so that a start costs
no more than a small solve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from adapter.effects.active import WHOLE
from adapter.effects.base import ALL, Effect
from adapter.gap.candidates import Candidate, base_of, signatures
from adapter.gap.evidence import Carried, Score, score, scores
from adapter.gap.fit import BAND_HZ, Fit
from adapter.gap.noise import LEAST_NM, ORDER, ROBUST, Noise, noise_of
from adapter.gap.patterns import Pattern, line, patterns
from adapter.records import Array

CATALOGUED, PATTERNS = "catalogued", "patterns"
BLOCK_S, DATE_STEP_S = 0.4, 0.04
# What does come in mid-recording; a base that tilts or an encoder that slips is rarer.
SUDDEN = ("payload", "external_wrench", "torque_offset", "coulomb_friction", "viscous_friction")
UNSURE_S = 0.16  # a date is not known better before the effect is refitted
FEWEST_BLOCKS = 1  # nothing shorter is dated
FIRST_SHARE = 0.2  # of the residual that may be noise, for a start
RICH_ROUNDS = 2
LONGEST_CONTACT_S = 8.0
MARGIN_S = 0.8  # a start so near either end is no change


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


def rich_noise(X: Array, candidates: Sequence[Candidate], residual: Array) -> Noise:
    """Noise of a residual (k, n) without what all signatures X (c, k, n) at once explain of it."""
    prior = np.zeros(len(X))
    for c in candidates:
        # patterns are so many that they would explain noise, but for a line that stands out
        if not isinstance(c.effect, Pattern) or c.effect.is_line:
            k = list(c.columns)
            prior[k] = np.maximum(prior[k], c.prior_std)
    X, prior = X[prior > 0.0], prior[prior > 0.0]
    sigma = FIRST_SHARE * residual.std(axis=0) + LEAST_NM
    white = (X / sigma).reshape(len(X), -1), (residual / sigma).ravel()
    for _ in range(RICH_ROUNDS):
        information = white[0] @ white[0].T
        information[np.diag_indices(len(X))] += prior**-2.0
        x = cho_solve(cho_factor(information, lower=True), white[0] @ white[1])
        noise = noise_of(residual - np.tensordot(x, X, 1), LEAST_NM, ROBUST)
        white = noise.whiten(X).reshape(len(X), -1), noise.whiten(residual).ravel()
    return noise


class Field:
    """All signatures of the recordings about the present model, white.

    The noise that whitens them is what the richest model of all leaves: whatever the catalogue
    can explain is taken out, the more so as nobody knows yet what it is. That is too little to
    believe a lead by, and right to find one.

    Args:
        fit: the model as it stands; joints: (from 0) that move.
        kind: of the candidates, `CATALOGUED` or `PATTERNS`.
        rich: whiten by that noise; by the fit's own where False.
    """

    def __init__(
        self, fit: Fit, joints: Sequence[int], kind: str = CATALOGUED, rich: bool = True
    ) -> None:
        tables, noise = [], []
        extra = self._patterns(fit, joints) if kind == PATTERNS else []
        self.candidates: list[Candidate] = []
        for i in range(len(fit.recordings)):
            own = fit.signals(i)
            table, self.candidates = signatures(own, base_of(own, fit.actives(i)), joints, extra)
            tables.append(table)
            if rich:
                noise.append(rich_noise(table, self.candidates, fit.residual(i)))
        if kind == PATTERNS:
            self.candidates = [c for c in self.candidates if isinstance(c.effect, Pattern)]
        self.fit = fit.with_noise(noise) if rich else fit
        self.tables = tables
        self.carried_tables = [self.fit.carried_signatures(i) for i in range(len(tables))]
        self.carried = self.fit.carried(self.carried_tables)
        self.targets = [
            r + np.tensordot(self.fit.coefficients, c, 1)
            for r, c in zip(self.fit.residuals(), self.carried_tables, strict=True)
        ]
        self.X = self.fit.whiten(tables)
        self.weights = self.fit.weights or tuple(np.ones_like(r.tau) for r in fit.recordings)
        self.times = [r.t[ORDER:] for r in fit.recordings]

    def _patterns(self, fit: Fit, joints: Sequence[int]) -> list[tuple[Effect, int]]:
        """What no effect of the catalogue has: patterns of each joint, and lines in time."""
        found: list[tuple[Effect, int]] = [(p, j) for j in joints for p in patterns(fit.n, j)]
        longest = max(fit.residuals(), key=len)
        for j in joints:
            peak = line(longest[:, j], BAND_HZ)
            if peak is not None:
                found.append((peak, j))
        return found

    def gated(self, lead: Lead) -> list[Array]:
        """Signatures (c, k, n) of a lead in each recording, in its interval alone."""
        return self.within(lead.interval_s, lead.recording, list(lead.candidate.columns))

    def within(
        self, interval_s: tuple[float, float], recording: int | None, columns: Any = slice(None)
    ) -> list[Array]:
        """Signatures (c, k, n) of each recording, zero outside an interval."""
        out = []
        for i, (table, own) in enumerate(zip(self.tables, self.fit.recordings, strict=True)):
            on = (own.t >= interval_s[0]) & (own.t < interval_s[1])
            if recording not in (None, i):
                on[:] = False
            out.append(table[columns] * on[:, None])
        return out

    def honest(self, lead: Lead) -> Lead:
        """A lead under the noise that it leaves itself, in place of that of the richest model."""
        if lead.interval_s != WHOLE:
            lead = self.dated(lead)
        found = self.together([lead])
        return replace(
            lead, log_evidence=found.log_evidence + lead.odds, chi2=found.chi2, x=found.x
        )

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
        lead_tables = [np.concatenate(x) for x in zip(*parts, strict=True)]
        tables = [np.concatenate(x) for x in zip(self.carried_tables, lead_tables, strict=True)]
        own_std = np.concatenate([lead.candidate.prior_std for lead in leads])
        weights = self._undated(leads)
        fit = replace(self.fit, weights=weights)
        prior_std = np.concatenate([fit.prior_std, own_std])
        x = Carried(fit.whiten(tables), prior_std, fit.whiten(self.targets)).x
        left = [t - np.tensordot(x, c, 1) for t, c in zip(self.targets, tables, strict=True)]
        quiet = [r * (w > 0.0) for r, w in zip(left, weights, strict=True)]
        fit = replace(fit, noise=tuple(noise_of(r) for r in quiet))
        N, X = fit.whiten(self.carried_tables), fit.whiten(lead_tables)
        others = Carried(N, fit.prior_std, fit.whiten(self.targets))
        return score(*others.without(X), own_std)

    def _undated(self, leads: Sequence[Lead]) -> tuple[Array, ...]:
        """Weights (k, n) of the rows: none where a lead's start is not known well enough yet."""
        out = []
        for i, (own, weight) in enumerate(zip(self.fit.recordings, self.weights, strict=True)):
            weight = weight.copy()
            for lead in leads:
                for edge in lead.interval_s if lead.recording in (None, i) else ():
                    near = (own.t > edge - UNSURE_S) & (own.t < edge + UNSURE_S + ORDER / BAND_HZ)
                    weight[near] = 0.0
            out.append(weight)
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
        G, g = self.carried.without(self.X)
        for c in self.candidates:
            k = np.ix_(c.columns, c.columns)
            found = score(G[k], g[list(c.columns)], c.prior_std)
            odds = log_odds(c)
            leads.append(Lead(c, found.log_evidence + odds, found.chi2, found.x, odds=odds))
        return leads

    def timed(self, candidates: Sequence[Candidate]) -> list[Lead]:
        """The best start of each candidate in each recording."""
        leads = []
        for i in range(len(self.fit.recordings)):
            edges, C, g, self_products = self._running(i, candidates)
            keep = self._starts(i, edges)
            if not len(keep):
                continue
            for c, G in zip(candidates, self_products, strict=True):
                k = list(c.columns)
                reduced = self.carried.reduced(G[keep], C[keep][:, k], g[keep][:, k])
                evidence, _ = scores(*reduced, c.prior_std)
                best = int(np.argmax(evidence))
                found = score(reduced[0][best], reduced[1][best], c.prior_std)
                odds = log_odds(c, timed=True) - float(np.log(len(keep)))
                when = (float(edges[keep[best]]), np.inf)
                worth = found.log_evidence + odds
                leads.append(Lead(c, worth, found.chi2, found.x, when, i, odds))
        return leads

    def passing(self, candidates: Sequence[Candidate]) -> list[Lead]:
        """The best interval of each candidate in each recording: it comes and goes."""
        leads = []
        longest = round(LONGEST_CONTACT_S / BLOCK_S)
        for i in range(len(self.fit.recordings)):
            edges, C, g, self_products = self._running(i, candidates)
            last = len(edges) - 1
            pairs = np.array(
                [
                    (a, b)
                    for a in range(last)
                    for b in range(a + FEWEST_BLOCKS, min(a + longest, last) + 1)
                ]
            )
            for c, G in zip(candidates if len(pairs) else [], self_products, strict=False):
                k = list(c.columns)
                parts = (G, C[:, k], g[:, k])
                reduced = self.carried.reduced(*(p[pairs[:, 0]] - p[pairs[:, 1]] for p in parts))
                evidence, _ = scores(*reduced, c.prior_std)
                best = int(np.argmax(evidence))
                found = score(reduced[0][best], reduced[1][best], c.prior_std)
                begin, end = (float(edges[x]) for x in pairs[best])
                odds = log_odds(c, passing=True) - float(np.log(len(pairs)))
                worth = found.log_evidence + odds
                leads.append(Lead(c, worth, found.chi2, found.x, (begin, end), i, odds))
        return leads

    def _starts(self, recording: int, edges: Array) -> np.ndarray:
        t = self.times[recording]
        inside = (edges > t[0] + MARGIN_S) & (edges < t[-1] - MARGIN_S)
        return np.flatnonzero(inside)

    def _running(
        self, recording: int, candidates: Sequence[Candidate]
    ) -> tuple[Array, Array, Array, list[Array]]:
        """Sums from each edge to the end: with the carried (b, c, N), the data (b, c), itself."""
        t, n = self.times[recording], self.fit.n
        begin = sum(len(x) for x in self.times[:recording]) * n
        rows = slice(begin, begin + len(t) * n)
        edges = np.append(np.arange(t[0], t[-1], BLOCK_S), t[-1] + 1.0)
        block = np.repeat(np.searchsorted(edges, t, side="right") - 1, n)
        cuts = np.searchsorted(block, np.arange(len(edges)))
        X, N, data = self.X[:, rows], self.carried.N[:, rows], self.carried.data[rows]
        size = len(edges)
        C, g = np.zeros((size, len(X), len(N))), np.zeros((size, len(X)))
        own = [np.zeros((size, len(c.columns), len(c.columns))) for c in candidates]
        for b in range(size - 2, -1, -1):
            part = slice(cuts[b], cuts[b + 1])
            C[b] = C[b + 1] + X[:, part] @ N[:, part].T
            g[b] = g[b + 1] + X[:, part] @ data[part]
            for G, c in zip(own, candidates, strict=True):
                x = X[list(c.columns), part]
                G[b] = G[b + 1] + x @ x.T
        return edges, C, g, own


def log_odds(c: Candidate, timed: bool = False, passing: bool = False) -> float:
    """ln of what a candidate is worth before the data, the ways to look for it included."""
    odds = -np.log(20.0) + c.effect.log_odds
    if c.joint >= 0:
        odds -= np.log(7.0)
    odds -= np.log(len(c.effect.templates()))
    if c.effect.scope == ALL and c.joint >= 0:
        odds -= 4.0  # signals of one bus are late together
    if c.effect.name == "external_wrench" and not passing:
        odds -= 6.0  # what pushes for a whole recording is rather a tilted base
    if timed or passing:
        odds -= 2.0 if c.effect.name in SUDDEN else 10.0
    return float(odds)
