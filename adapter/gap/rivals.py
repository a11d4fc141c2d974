"""How a named effect stands against its rivals: other names for the same data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.base import LATE
from adapter.effects.torque import sensors
from adapter.gap.candidates import Candidate, is_finer, log_odds, simpler_wins
from adapter.gap.evidence import Carried, scores
from adapter.gap.fit import Fit, Named, beside, distance_of, refitted
from adapter.gap.scan import SignatureTable
from adapter.model.spatial import Array

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

    @property
    def is_alike(self) -> bool:
        """Whether it is another name for the named effect, and not another effect."""
        return self.overlap > 0.5  # of a signature that another name for it explains


@dataclass(frozen=True, eq=False)
class Standing:
    """A named effect among its rivals.

    Attributes:
        candidate: the named effect.
        log_evidence: nats over nothing, its odds included; chi2: fall of the squared distance.
        rivals: the most credible first.
        tried: keys of effects that gave way to it: no simpler one of them is a rival any more.
    """

    candidate: Candidate
    log_evidence: float
    chi2: float
    rivals: tuple[Rival, ...]
    tried: frozenset[tuple[str, int]] = frozenset()

    @property
    def probability(self) -> float:
        """Posterior probability against the best rival."""
        others = (rival for rival in self.rivals if rival.credible and rival.is_alike)
        behind = max(map(self.gain, others), default=-np.inf)
        return float(1.0 / (1.0 + np.exp(min(behind, 700.0))))

    def gain(self, rival: Rival) -> float:
        """Nats by which a rival is the better name; infinite where simplicity decides."""
        mine, other = (self.candidate, self.chi2), (rival.candidate, rival.chi2)
        if simpler_wins(mine, other):
            return -np.inf
        tried = rival.candidate.key in self.tried
        if tried and is_finer(self.candidate, rival.candidate):
            return -np.inf
        if simpler_wins(other, mine):
            return np.inf
        better = rival.log_evidence - self.log_evidence
        return min(better, 0.0) if tried else better  # in its place it explained less


def price(named: Named) -> float:
    """ln of what a named effect was worth before the data (negative), dates included."""
    timed, passing = named.interval_s != WHOLE, bool(np.isfinite(named.interval_s[1]))
    odds = log_odds(named.candidate, timed=timed, passing=passing)
    return float(odds - np.log(DATES) * (timed + passing))


# Of all candidates' white signatures in one interval: (c, p) products with the fit's own, (c,) with
# the data, and (k, k) of each candidate's with one another.
_Products = tuple[Array, Array, tuple[Array, ...]]


def standings(fit: Fit, carried: Carried, table: SignatureTable) -> tuple[Standing, ...]:
    """Each named effect of a fit against all candidates in its interval."""
    products: dict[object, _Products] = {}
    out = []
    for k, named in enumerate(fit.named):
        when = (named.interval_s, named.recording)
        if when not in products:
            X = fit.whiten(table.within(*when))
            own = tuple(X[list(c.columns)] @ X[list(c.columns)].T for c in table.candidates)
            products[when] = X @ carried.N.T, X @ carried.data, own
        out.append(_standing(fit, carried, table.candidates, products[when], k))
    return tuple(out)


def _standing(
    fit: Fit, carried: Carried, candidates: Sequence[Candidate], products: _Products, k: int
) -> Standing:
    """The k-th named effect of a fit among the candidates."""
    named, (own, rest) = fit.named[k], beside(fit, k)
    mine = carried.worth(own, rest)
    value = mine.log_evidence + price(named)
    found = _rivals(named, candidates, products, carried, own, rest)
    if named.candidate.effect.form == LATE and value > 0.0:
        without = mine.chi2 + _in_band(fit)
        found = [_exact(fit, k, without, rival) for rival in found]
    best: dict[tuple[str, int], Rival] = {}
    for rival in sorted(found, key=lambda x: -x.log_evidence):
        if named.interval_s == WHOLE or not rival.candidate.effect.steady:
            best.setdefault(rival.candidate.key, rival)
    best.pop(named.candidate.key, None)
    rivals = (
        replace(r, credible=r.credible and not any(e.covers(r.candidate) for e in fit.named))
        for r in best.values()
    )
    return Standing(named.candidate, value, mine.chi2, tuple(rivals), named.tried)


def _exact(fit: Fit, k: int, without: float, rival: Rival) -> Rival:
    """A rival of the k-th named effect as a fit has it in that one's place.

    Only of what makes torques late, which is linear for less than a sample or two alone.

    Args:
        without: squared distance in the band with neither.
    """
    if not (rival.is_alike and rival.candidate.effect.form == LATE):
        return rival
    trial, _ = refitted(fit.instead(k, replace(fit.named[k], candidate=rival.candidate, x=rival.x)))
    told = without - _in_band(trial)
    worth, x = rival.log_evidence + 0.5 * (told - rival.chi2), trial.named[k].x
    credible = rival.candidate.possible(x, fit.named[k].interval_s)
    return replace(rival, log_evidence=worth, chi2=told, x=x, credible=credible)


def _in_band(fit: Fit) -> float:
    """Squared distance of a fit without the noise of the motion, which any low-pass takes off."""
    left = []
    for i, own in enumerate(fit.recordings):
        at, actives = fit.model.stages(i), fit.model.actives(i)
        rigid = np.column_stack([at.links.inside_band(x, j) for j, x in enumerate(at.rigid.T)])
        sensed = sensors(at.links, rigid + at.total - at.rigid, actives)
        left.append(own.heard * (own.tau - own.low(sensed)))
    return distance_of(fit, left)


def _rivals(
    named: Named,
    candidates: Sequence[Candidate],
    products: _Products,
    carried: Carried,
    own: np.ndarray,
    rest: np.ndarray,
) -> list[Rival]:
    """Every candidate in the place of a named effect, in order.

    Its coefficients are at `own`; all but these, at `rest`, have explained what they can.
    """
    others, mine = carried.part(rest), named.x @ carried.G[own]
    with_fit, with_data, alone = products
    C = with_fit[:, rest]
    solved = others.solved(C)
    size = float(mine[own] @ named.x - others.solved(mine[rest]) @ mine[rest])
    cross = with_fit[:, own] @ named.x - solved @ mine[rest]
    left = with_data - solved @ others.g
    found: dict[int, Rival] = {}
    alike: dict[int, list[int]] = {}
    for i, c in enumerate(candidates):
        alike.setdefault(len(c.columns), []).append(i)
    for places in alike.values():
        at = np.array([candidates[i].columns for i in places])
        std = np.array([candidates[i].prior_std for i in places])
        G = np.array([alone[i] for i in places])
        G -= solved[at] @ C[at].swapaxes(1, 2)
        evidence, chi2, x = scores(G, left[at], std)
        wide = G + (10.0 * std[:, :, None]) ** -2.0 * np.eye(at.shape[1])  # how far it could go
        reached = np.linalg.solve(wide, cross[at][..., None])[..., 0]
        overlap = np.einsum("bi,bi->b", cross[at], reached) / size
        for b, i in enumerate(places):
            c = candidates[i]
            worth = float(evidence[b]) + price(replace(named, candidate=c))
            possible = c.possible(x[b], named.interval_s)
            found[i] = Rival(c, worth, float(chi2[b]), float(overlap[b]), x[b], possible)
    return [found[i] for i in sorted(found)]
