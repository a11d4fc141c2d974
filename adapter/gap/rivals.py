"""How a named effect stands: against its rivals, and on data that its fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.effects.active import WHOLE
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried, score
from adapter.gap.fit import Fit, Named, beside
from adapter.gap.noise import ORDER
from adapter.gap.patterns import Pattern
from adapter.gap.scan import Field, log_odds
from adapter.records import Array

FOLDS = 4
FOLD_S = 2.0  # a block of time is held out as a whole: neighbours know each other
WIDE = 10.0  # times its prior: what a rival may be when it is asked how far it could go
SHORTEST_S = 0.2
TIE_CHI2 = 2.0  # by which held-out data may be worse and still leave it to the evidence
PATTERN_SHARE = 0.7  # of what a pattern explains: an effect that explains so much goes first
DATES = 50.0  # starts that were looked at


@dataclass(frozen=True, eq=False)
class Rival:
    """Another name for the same data.

    Attributes:
        candidate: what and where; log_evidence: nats over nothing, its odds included;
        chi2: fall of the squared distance.
        overlap: share of the named effect's signature that it explains on these data.
        x: its coefficients.
        credible: physics allows these coefficients, and the effect is not named already.
    """

    candidate: Candidate
    log_evidence: float
    chi2: float
    overlap: float
    x: Array
    credible: bool


@dataclass(frozen=True, eq=False)
class Standing:
    """A named effect among its rivals.

    Attributes:
        candidate: the named effect.
        log_evidence: nats over nothing, its odds included; chi2: fall of the squared distance.
        rivals: the most credible first.
    """

    candidate: Candidate
    log_evidence: float
    chi2: float
    rivals: tuple[Rival, ...]

    @property
    def probability(self) -> float:
        """Posterior probability against the best rival."""
        behind = max((self.gain(rival) for rival in self.rivals if rival.credible), default=-np.inf)
        return float(1.0 / (1.0 + np.exp(min(behind, 700.0))))

    def gain(self, rival: Rival) -> float:
        """Nats by which a rival is the better name; infinite where simplicity decides."""
        mine, other = (self.candidate, self.chi2), (rival.candidate, rival.chi2)
        if simpler_wins(mine, other):
            return -np.inf
        if simpler_wins(other, mine):
            return np.inf
        return rival.log_evidence - self.log_evidence


def simpler_wins(simple: tuple[Candidate, float], other: tuple[Candidate, float]) -> bool:
    """Whether `simple` is the simpler of two candidates, and explains (chi2) all but as much.

    Its finer form must add a share to what an effect explains, and a pattern must explain
    clearly more than an effect of the catalogue.
    """
    (a, mine), (b, theirs) = simple, other
    if isinstance(b.effect, Pattern):
        beside = a.joint in (b.joint, -1) and not isinstance(a.effect, Pattern)
        return beside and mine > PATTERN_SHARE * theirs
    share = b.effect.simpler.get(a.effect.name)
    return share is not None and a.joint == b.joint and theirs < (1.0 + share) * mine


def price(named: Named) -> float:
    """ln of what a named effect was worth before the data (negative), dates included."""
    timed, passing = named.interval_s != WHOLE, bool(np.isfinite(named.interval_s[1]))
    odds = log_odds(named.candidate, timed=timed, passing=passing)
    return float(odds - np.log(DATES) * (timed + passing))


def standing(fit: Fit, carried: Carried, field: Field, k: int) -> Standing:
    """The k-th named effect of a fit against all candidates in its interval."""
    named = fit.named[k]
    own, rest = beside(fit, k)
    others = Carried(carried.N[rest], carried.prior_std[rest], carried.data)
    mine = score(*others.without(carried.N[own]), named.candidate.prior_std)
    X = fit.whiten(field.within(named.interval_s, named.recording))
    signature = named.x @ carried.N[own]
    G, g = others.without(np.vstack([X, signature]))
    found, taken = [], {e.candidate.key for e in fit.named}
    for c in field.candidates:
        if c.key == named.candidate.key:
            continue
        at = list(c.columns)
        block, cross = G[np.ix_(at, at)], G[at, -1]
        wide = block + np.diag((WIDE * c.prior_std) ** -2.0)
        overlap = float(cross @ np.linalg.solve(wide, cross) / G[-1, -1])
        other = score(block, g[at], c.prior_std)
        odds = price(Named(c, other.x, named.interval_s, named.recording))
        credible = c.key not in taken and c.effect.possible(c.template.decode(other.x))
        found.append(Rival(c, other.log_evidence + odds, other.chi2, overlap, other.x, credible))
    found.sort(key=lambda rival: -rival.log_evidence)
    return Standing(
        named.candidate, mine.log_evidence + price(named), mine.chi2, tuple(_best_of_each(found))
    )


def _best_of_each(rivals: list[Rival]) -> list[Rival]:
    best: dict[tuple[str, int], Rival] = {}
    for rival in rivals:
        best.setdefault(rival.candidate.key, rival)
    return list(best.values())


def block_s(fit: Fit) -> float:
    """Length of the blocks that are held out: what lasts but a second is in several of them."""
    spans = [e.interval_s[1] - e.interval_s[0] for e in fit.named]
    return float(max(min([FOLD_S, *(x / (2 * FOLDS) for x in spans)]), SHORTEST_S))


def fold_of(t: Array, block: float) -> np.ndarray:
    """(m,) fold of each instant: blocks of time in turn."""
    return np.asarray((t // block).astype(int) % FOLDS)


def fold_rows(fit: Fit) -> np.ndarray:
    """(r,) fold of each white row."""
    rows = []
    for own in fit.recordings:
        rows.append(np.repeat(fold_of(own.t[ORDER:], block_s(fit)), fit.n))
    return np.concatenate(rows)


def pays_held_out(fit: Fit, carried: Carried, k: int) -> bool:
    """Whether the k-th named effect predicts blocks that its fit has not seen."""
    fold = fold_rows(fit)
    own, rest = beside(fit, k)
    if fit.named[k].candidate.effect.name == "signal_delay":  # the carried error would stand for it
        rest = rest[rest != fit.dtheta.size]
    gain = 0.0
    for f in range(FOLDS):
        seen, new = fold != f, fold == f
        for sign, at in ((1.0, rest), (-1.0, np.concatenate([rest, own]))):
            fitted = Carried(carried.N[np.ix_(at, seen)], carried.prior_std[at], carried.data[seen])
            left = carried.data[new] - fitted.x @ carried.N[np.ix_(at, new)]
            gain += sign * float(left @ left)
    return gain > -TIE_CHI2
