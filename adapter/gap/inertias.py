"""When the model's inertias are wrong altogether, and not one effect is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adapter.effects import CATALOGUE
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, Named, refitted
from adapter.gap.noise import ORDER
from adapter.gap.rivals import Standing, price
from adapter.gap.search import Found

WIDE = 25.0  # times the prior: inertias of which next to nothing is known
FEWEST_NAMED = 3  # fewer effects than that are no sign of a wrong model
MARGIN = 30.0  # nats
ODD = 3.0  # prior deviations from which on a link's inertia is wrong


def log_marginal(fit: Fit, carried: Carried) -> float:
    """ln p(data) of a model under its own noise, up to a constant of the data."""
    information = carried.N @ carried.N.T * np.outer(carried.prior_std, carried.prior_std)
    log_det = np.linalg.slogdet(information + np.eye(len(carried.N)))[1]
    misfit = float(carried.data @ carried.data - carried.g @ carried.x)
    sizes = sum(
        (len(r.t) - ORDER) * float(np.log(noise.sigma).sum())
        for r, noise in zip(fit.recordings, fit.noise, strict=True)
    )
    odds = sum(price(e) for e in fit.named)
    return float(-0.5 * misfit - 0.5 * log_det - sizes + odds)


def wrong_inertias(fit: Fit, found: Found, joints: Sequence[int]) -> Found | None:
    """The links' inertias as findings, where they explain more than all that was named.

    Args:
        fit: the nominal model; found: what a search with trusted inertias ended with.
    """
    if len(found.fit.named) < FEWEST_NAMED:
        return None
    wide, carried = refitted(replace(fit, prior=WIDE * fit.prior))
    for _ in range(2):
        wide, carried = refitted(wide.with_noise())
    gain = log_marginal(wide, carried) - log_marginal(found.fit, found.carried)
    if gain < MARGIN:
        return None
    return _as_findings(fit, wide, carried, gain)


def _as_findings(fit: Fit, wide: Fit, carried: Carried, gain: float) -> Found:
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
        standings.append(Standing(named[-1].candidate, gain, 2.0 * gain, ()))
        dtheta[k] = 0.0
    final = replace(wide, dtheta=dtheta, named=tuple(named), prior=fit.prior)
    return Found(final, final.carried(), tuple(standings))
