"""What a recording would not have shown: how large an effect had to be to be named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.effects.active import WHOLE
from adapter.effects.catalogue import CATALOGUE, HELD
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, place_of
from adapter.gap.real_arm import SURE
from adapter.gap.result import Unseen
from adapter.gap.scan import BELIEF, SignatureTable, least_chi2
from adapter.gap.search import Found
from adapter.model.spatial import Array

SURELY = 1.3  # standard deviations: of effects so much larger noise hides one in ten
STEP, OPEN = 1e-3, 100.0  # of a coefficient's prior: for slopes; how wide it is taken here


def unseen(found: Found, joints: Sequence[int]) -> tuple[Unseen, ...]:
    """Of each effect that was not named, and each joint that moves, the least that would be.

    Of effects that last and have one size: not the finer forms of friction, which are sought
    beside a plain one, nor whole bodies.

    Args:
        joints: (from 0) that move.
    """
    fit = found.fit
    told = [k for k in range(len(fit.named)) if k not in found.weak]
    named = {x.candidate.key for k in told for x in (fit.named[k], found.standings[k])}
    table = SignatureTable(fit, joints, rich=False)
    best: dict[tuple[str, int], Unseen] = {}
    for c in table.candidates:
        whole_body = c.columns_are_theta and c.template.theta is None
        usual = c.effect.name in CATALOGUE and not (c.effect.simpler or c.effect.passing)
        if not usual or whole_body or c.key in named:
            continue
        own = _least(c, table.X[list(c.columns)], fit, table.carried)
        if own is None:
            continue
        other = best.setdefault(c.key, own)
        if (own.size > other.size) == own.above:
            best[c.key] = own
    return tuple(best.values())


def _least(c: Candidate, X: Array, fit: Fit, carried: Carried) -> Unseen | None:
    """The least size of an effect with white signatures X (k, r) that is named, all else free.

    None where no size would be that an arm may have.
    """
    rest = _beside(c, fit)
    G, _ = carried.part(rest).reduced(X @ X.T, X @ carried.N[rest].T, X @ carried.data)
    std, effect = c.prior_std, CATALOGUE[c.effect.name]
    ways = np.linalg.slogdet(np.eye(len(G)) + std[:, None] * G * std)[1]
    asked = max(least_chi2(effect, WHOLE), 2.0 * (BELIEF - c.log_odds) + ways)
    asked = SURE**2 if effect is HELD else asked
    covariance = np.linalg.inv(G + np.diag((OPEN * std) ** -2.0))
    key = effect.phrase.key or effect.parameters[0].key

    def value(x: Array) -> float:
        return float(c.template.decode(x)[key])

    at = std / np.arange(1, len(std) + 1)
    slope = np.array([value(at + x) - value(at) for x in STEP * np.diag(std)]) / (STEP * std)
    size = (np.sqrt(asked) + SURELY) * np.sqrt(slope @ covariance @ slope)
    if size > 20.0 * np.linalg.norm(slope * std):  # times its prior: nothing is so large
        return None
    above = len(std) == 1 and slope[0] < 0.0  # what is stiff does not show
    if above:
        size = value((np.sqrt(asked) + SURELY) * np.sqrt(covariance[0]))
    return Unseen(effect.name, c.joint + 1, key, float(size), c.units[key], bool(above))


def _beside(c: Candidate, fit: Fit) -> np.ndarray:
    """Coefficients that are carried along with a candidate: not those of its like on its joint."""
    form, out = c.effect.form, []
    for k, e in enumerate(fit.named):
        other = e.candidate
        like = other.key == c.key or (form and other.effect.form == form)
        if other.joint != c.joint or not like:
            out.append(place_of(fit, k))
    first = np.arange(len(fit.coefficients) - sum(len(e.x) for e in fit.named))
    return np.concatenate([first, *out])
