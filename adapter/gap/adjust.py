"""Dates and nonlinear settings of what has been named, as the data like them best."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adapter.effects.active import WHOLE
from adapter.gap.fit import Fit, refitted


def dated(fit: Fit, place: int) -> Fit:
    """A named effect with the start (and end) that the data like best, on a grid of 8 ms.

    All rows count here, those around the dates above all.
    """
    fit = replace(fit, weights=())
    for reach in (0.06, 0.02, 0.008):
        for side in (0, 1):
            centre = fit.named[place].interval_s[side]
            if np.isfinite(centre):
                trials = [_moved(fit, place, side, centre + reach * k) for k in range(-3, 4)]
                fit = min(trials, key=_distance)
        fit, _ = refitted(fit, 1)
    return fit


def dated_anew(fit: Fit) -> Fit:
    """With the dates of all named effects sought again: one of them has another name now."""
    fit, _ = refitted(fit)
    for k, e in enumerate(fit.named):
        if e.interval_s != WHOLE:
            fit = dated(fit, k)
    return fit


def shaped(fit: Fit, place: int) -> Fit:
    """A named effect with the nonlinear setting that the data like best."""
    for step in (1.25, 1.08, 1.03):
        named = fit.named[place]
        trials = [fit]
        for ratio in (step**-2, 1.0 / step, step, step**2):
            template = named.candidate.effect.reshaped(named.values, ratio)
            if template is None:
                return fit
            other = replace(named, candidate=replace(named.candidate, template=template))
            changed = (*fit.named[:place], other, *fit.named[place + 1 :])
            trials.append(refitted(replace(fit, named=changed), 1)[0])
        fit = min(trials, key=_distance)
    return fit


def _moved(fit: Fit, place: int, side: int, t: float) -> Fit:
    named = list(fit.named)
    interval = list(named[place].interval_s)
    interval[side] = t
    named[place] = replace(named[place], interval_s=(interval[0], interval[1]))
    return replace(fit, named=tuple(named))


def _distance(fit: Fit) -> float:
    """Squared distance, in units of the noise, with what the coefficients cost."""
    white = fit.whiten(fit.residuals())
    return float(white @ white + np.sum((fit.coefficients / fit.prior_std) ** 2))
