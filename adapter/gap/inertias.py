"""When the model's inertias are wrong altogether, and not one effect is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adapter.effects import CATALOGUE
from adapter.effects.active import WHOLE
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried, score
from adapter.gap.fit import Fit, Named, refitted
from adapter.gap.rivals import Standing
from adapter.gap.search import Found

WIDE = 25.0  # times the prior: inertias of which next to nothing is known
FEWEST_LINKS = 3  # fewer wrong links than that can be named one by one
RATIO = 8.0  # of the squared torque of wrong bodies over that of all else that was named
ODD = 3.0  # prior deviations from which on a link's inertia is wrong


def wrong_inertias(fit: Fit, found: Found, joints: Sequence[int]) -> Found | None:
    """The links' inertias as findings, where they explain more than all that was named.

    Args:
        fit: the nominal model; found: what a search with trusted inertias ended with.
    """
    if not _all_over(found.fit):
        return None
    wide, carried = refitted(replace(fit, prior=WIDE * fit.prior))
    for _ in range(2):
        wide, carried = refitted(wide.with_noise())
    return _as_findings(fit, wide, carried)


def _all_over(fit: Fit) -> bool:
    """Whether bodies are what is wrong, on several links, and anything else is small beside."""
    sizes = [float(np.mean(fit.contribution(0, k) ** 2)) for k in range(len(fit.named))]
    wrong = [e.candidate.columns_are_theta and e.interval_s == WHOLE for e in fit.named]
    bodies = sum(size for size, body in zip(sizes, wrong, strict=True) if body)
    others = sum(size for size, body in zip(sizes, wrong, strict=True) if not body)
    return sum(wrong) >= FEWEST_LINKS and bodies > RATIO * others


def _standing(wide: Fit, carried: Carried, named: Named) -> Standing:
    """What the link's correction is worth, the other links' carried along."""
    own = np.array(named.candidate.columns)
    rest = np.delete(np.arange(len(carried.N)), own)
    others = Carried(carried.N[rest], carried.prior_std[rest], carried.data)
    found = score(*others.without(carried.N[own]), carried.prior_std[own])
    return Standing(named.candidate, found.log_evidence, found.chi2, ())


def _as_findings(fit: Fit, wide: Fit, carried: Carried) -> Found:
    """Links that are off by more than their prior allows, named one by one."""
    named, standings, dtheta = [], [], wide.dtheta.copy()
    for k in range(fit.n):
        if np.abs(wide.dtheta[k] / fit.prior[k]).max() < ODD:
            continue
        effect = CATALOGUE["link_inertia"]
        columns = tuple(range(10 * k, 10 * k + 10))
        scale = tuple(float(x) for x in wide.prior[k])
        template = replace(effect.templates()[0], prior_std=scale)
        named.append(Named(Candidate(effect, template, k, columns), wide.dtheta[k].copy()))
        standings.append(_standing(wide, carried, named[-1]))
        dtheta[k] = 0.0
    final = replace(wide, dtheta=dtheta, named=tuple(named), prior=fit.prior)
    return Found(final, final.carried(), tuple(standings))
