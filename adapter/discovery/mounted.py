"""Hypotheses where frames may be any: what the convention explains, and what free axes do.

A frame that turns about its z with its origin on the axis is believed to be meant so; a sensor
mounted anyhow does so only by accident. So an axis that had to be found costs a link a little,
which decides nothing where links are left unexplained else, and the direction of edges where
the frames of some links keep the convention. Without those, a pair looks the same from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.discovery.axes import Axes, axes_of
from adapter.discovery.bodies import LEVER_M, Bodies
from adapter.discovery.hypotheses import (
    LOST,
    Hypotheses,
    Option,
    Ruler,
    best_ratios,
    convention_fits,
    convention_options,
    least_ratios,
    promising,
    ranked,
)
from adapter.discovery.mounting import Mounted, mount
from adapter.spatial import Array

MOUNT_PRIOR = -5.0  # log odds of a frame that does not turn about its z
MOST_MOUNTED = 24  # pairs of a link that are fitted; with more of them nothing is decided

Pair = tuple[int, int, int]  # joint, and two bodies of which the first is a link and moves


@dataclass(frozen=True)
class _Pairs:
    """What is known of pairs before any is fitted: (joints, links, bodies) each."""

    axes: Axes
    variance: dict[str, Array]
    ratio: dict[str, Array]


def mounted_hypotheses(bodies: Bodies, misfit: dict[str, Array]) -> Hypotheses:
    """Options with free axes beside those that keep the convention.

    Args:
        bodies: what they are about.
        misfit: bounds as of `convention_misfit`.
    """
    ruler = Ruler(bodies)
    pairs = _pairs_of(ruler)
    least = least_ratios(ruler, misfit)
    for k, x in pairs.ratio.items():
        least[k] = np.minimum(least[k], x.min(axis=(0, 2)))
    ruler.learn_excess({k: x for k, x in least.items() if k in pairs.ratio})
    kept = convention_fits(ruler, misfit)
    fits = _fitted(ruler, pairs)
    best = []
    for j in range(bodies.links):
        own = [_ratios(pairs, at, fit) for at, fit in fits.items() if j in at[1:]]
        best.append(best_ratios(own + ruler.ratios(j, kept[j])))
    best = [ratios for ratios in best if ratios]
    ruler.learn_excess({k: np.array([ratios[k] for ratios in best]) for k in bodies.channels})
    found = [convention_options(ruler, j, kept[j], misfit) for j in range(bodies.links)]
    _add_mounted(found, ruler, pairs, fits)
    options = tuple(ranked(_best(o), ruler, j, MOUNT_PRIOR) for j, o in enumerate(found))
    return Hypotheses(bodies, options, ruler.excess, ruler.tolerance, True)


def _pairs_of(ruler: Ruler) -> _Pairs:
    bodies = ruler.bodies
    variance = {}
    for k, x in ruler.variance.items():
        both = x[:, :-1].transpose(1, 0, 2).copy()
        for name, by in (("v", "w"), ("a", "dw")):
            if name == k:
                both += (2.0 / 3.0) * LEVER_M**2 * bodies.noise[by][: bodies.links, None]
        own = both[:, :, : bodies.links]
        own[:] = 0.5 * (own + own.transpose(0, 2, 1))
        variance[k] = both
    axes = axes_of(bodies, ruler.variance)
    ratio = {}
    for k, x in axes.misfit.items():
        ratio[k] = x / (3.0 * variance[k])  # one of three components
        ratio[k][bodies.resting] = np.inf
        ratio[k][:, bodies.at_rest] = np.inf
        ratio[k][:, np.arange(bodies.links), np.arange(bodies.links)] = np.inf
    return _Pairs(axes, variance, ratio)


def _fitted(ruler: Ruler, pairs: _Pairs) -> dict[Pair, Mounted]:
    """Each promising pair once, the link with the lower number first."""
    bodies = ruler.bodies
    bound = ruler.total(pairs.ratio)
    wanted: set[Pair] = set()
    for j in np.flatnonzero(~bodies.at_rest).tolist():
        for s, i in promising(bound[:, j], ruler.free_score() - LOST, MOST_MOUNTED):
            swap = i < j and not bodies.at_rest[i]
            wanted.add((s, i, j) if swap else (s, j, i))
    return {at: _fit(ruler, pairs, at) for at in sorted(wanted)}


def _fit(ruler: Ruler, pairs: _Pairs, at: Pair) -> Mounted:
    """A pair's fit; begun at its other link too where the first leaves more than noise.

    Both sides have the same minimum, but not the same ways into others.
    """
    s, j, i = at
    of = {k: float(x[at]) for k, x in pairs.variance.items()}
    fit = mount(ruler.bodies, (j, i), s, pairs.axes.axis[at], of)
    if i >= ruler.bodies.links or ruler.total(_ratios(pairs, at, fit)) >= 0.0:
        return fit
    other = mount(ruler.bodies, (i, j), s, pairs.axes.axis[s, i, j], of)
    if sum(other.misfit[k] / of[k] for k in of) >= sum(fit.misfit[k] / of[k] for k in of):
        return fit
    return Mounted(other.parent, other.child, other.misfit)


def _ratios(pairs: _Pairs, at: Pair, fit: Mounted) -> dict[str, float]:
    return {k: fit.misfit[k] / float(x[at]) for k, x in pairs.variance.items()}


def _add_mounted(
    found: list[list[Option]], ruler: Ruler, pairs: _Pairs, fits: dict[Pair, Mounted]
) -> None:
    """Options of both ends of each pair; with its bound where it was not fitted."""
    worst = ruler.free_score() - LOST
    bound = ruler.total(pairs.ratio)
    for s, j, i in zip(*np.nonzero(bound >= worst), strict=True):
        at = int(s), int(j), int(i)
        mirror = at[0], at[2], at[1]
        score, mounting = float(bound[at]), None
        if at in fits:
            score, mounting = float(ruler.total(_ratios(pairs, at, fits[at]))), fits[at].child
        elif mirror in fits:
            score = float(ruler.total(_ratios(pairs, mirror, fits[mirror])))
            mounting = fits[mirror].parent
        if score >= worst:
            found[at[1]].append(Option(at[1], at[0], at[2], score + MOUNT_PRIOR, mounting))


def _best(options: list[Option]) -> list[Option]:
    """Of those that differ in the mounting only the better one."""
    out: dict[tuple[int, int], Option] = {}
    for option in sorted(options, key=lambda o: -o.score):
        out.setdefault((option.joint, option.parent), option)
    return list(out.values())
