"""How a named effect stands against its rivals: other names for the same data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.gap.candidates import Candidate, log_odds, simpler_wins
from adapter.gap.evidence import Carried, scores
from adapter.gap.fit import Fit, Named, beside
from adapter.gap.scan import SignatureTable
from adapter.model.spatial import Array

WIDE = 10.0  # times its prior: what a rival may be when it is asked how far it could go
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


def price(named: Named) -> float:
    """ln of what a named effect was worth before the data (negative), dates included."""
    timed, passing = named.interval_s != WHOLE, bool(np.isfinite(named.interval_s[1]))
    odds = log_odds(named.candidate, timed=timed, passing=passing)
    return float(odds - np.log(DATES) * (timed + passing))


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of all candidates' white signatures in one interval.

    Attributes:
        carried: (c, p) with the fit's own; data: (c,) with the data.
        own: of each candidate with itself, (k, k).
    """

    carried: Array
    data: Array
    own: tuple[Array, ...]


def standings(fit: Fit, carried: Carried, field: SignatureTable) -> tuple[Standing, ...]:
    """Each named effect of a fit against all candidates in its interval."""
    products: dict[object, _Products] = {}
    out = []
    for k, named in enumerate(fit.named):
        when = (named.interval_s, named.recording)
        if when not in products:
            X = fit.whiten(field.within(*when))
            own = tuple(X[list(c.columns)] @ X[list(c.columns)].T for c in field.candidates)
            products[when] = _Products(X @ carried.N.T, X @ carried.data, own)
        out.append(_standing(fit, carried, field.candidates, products[when], k))
    return tuple(out)


def _standing(
    fit: Fit, carried: Carried, candidates: Sequence[Candidate], products: _Products, k: int
) -> Standing:
    """The k-th named effect of a fit among the candidates."""
    named = fit.named[k]
    own, rest = beside(fit, k)
    others, mine = carried.part(rest), carried.worth(own, rest)
    beside_me = named.x @ carried.G[np.ix_(own, rest)]  # my signature's products with the others
    alone = named.x @ carried.G[np.ix_(own, own)] @ named.x
    size = alone - others.solved(beside_me) @ beside_me
    C = products.carried[:, rest]
    solved = others.solved(C)
    g = products.data - solved @ others.g
    cross = products.carried[:, own] @ named.x - solved @ beside_me
    found = []
    taken = {e.candidate.key for e in fit.named}
    for places in _alike(candidates):
        at = np.array([candidates[i].columns for i in places])
        std = np.array([candidates[i].prior_std for i in places])
        G = np.array([products.own[i] for i in places]) - solved[at] @ C[at].swapaxes(1, 2)
        evidence, chi2, x = scores(G, g[at], std)
        wide = G + (WIDE * std[:, :, None]) ** -2.0 * np.eye(at.shape[1])
        reached = np.linalg.solve(wide, cross[at][..., None])[..., 0]
        overlap = np.einsum("bi,bi->b", cross[at], reached) / size
        for b, i in enumerate(places):
            c = candidates[i]
            odds = price(replace(named, candidate=c))
            found.append((float(evidence[b]) + odds, i, float(chi2[b]), float(overlap[b]), x[b]))
    best: dict[tuple[str, int], Rival] = {}
    for worth, i, fall, share, at_best in sorted(found, key=lambda entry: (-entry[0], entry[1])):
        c = candidates[i]
        if c.key not in best and c.key != named.candidate.key:
            credible = c.key not in taken and c.effect.possible(c.template.decode(at_best))
            best[c.key] = Rival(c, worth, fall, share, at_best, credible)
    evidence_of_mine = mine.log_evidence + price(named)
    return Standing(named.candidate, evidence_of_mine, mine.chi2, tuple(best.values()))


def _alike(candidates: Sequence[Candidate]) -> list[list[int]]:
    """Places of the candidates, those of as many coefficients together."""
    groups: dict[int, list[int]] = {}
    for i, c in enumerate(candidates):
        groups.setdefault(len(c.columns), []).append(i)
    return list(groups.values())
