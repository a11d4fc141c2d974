"""What a learner's moments say under the held priors: the judgement that every door asks.

ADAM follows the arm sample by sample; what a run says of it at the end is this. Friction, offsets,
motors, a load at the hand and the documented inertias are judged together, from the same moments
that ADAM learned from, so that a recording gives the same numbers as `adapter gap` and `load`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.judgement.noise import MEMORY_S
from adapter.judgement.posterior import Moments, Part, judge
from adapter.judgement.priors import DOCUMENTED_SHARE, EFFECT_STD, theta_prior
from adapter.learning.theta import PRIOR_STD, Theta, neutral_body
from adapter.model.spatial import Array
from adapter.screening.likelihood import LOAD_STD

Load = tuple[Array, Array]  # θ (10,) about the hand's origin, and its covariance (10, 10)


class LearnedPosterior(NamedTuple):
    """What is known of an arm that was learned.

    Attributes:
        effects, std: (e, n) of the effects' parameters.
        held: what the hand carries beside the documented arm from the first sample on.
        payload: what a change at the hand brought; None without one.
        covariance: (10 bodies, 10 bodies) of θ in use as ADAM has it, its noise with memory.
        joint: (10 n + e n, 10 n + e n) of the links' θ with what the hand carries, and of effects.
    """

    effects: Array
    std: Array
    held: Load
    payload: Load | None
    covariance: Array
    joint: Array


def learned_posterior(
    theta: Theta, documented: Array | None, period_s: float, memory_s: Array | None
) -> LearnedPosterior:
    """Judge the moments of θ and the effects beside it.

    Coefficients are a load (10), what a change brought (10), the links' errors (10 n) and the
    effects' parameters (e n).

    Args:
        documented: (n, 10) θ of the links, which the prior is around; neutral bodies, as ADAM
            begins with, and no load before a change, where None.
        period_s: that one sample of the moments stands for.
        memory_s: (n,) of the noise; the shortest where nobody has seen it.
    """
    n, spare = theta.tree.n, theta.spare_in_use
    links, effects = slice(20, 20 + 10 * n), slice(20 + 10 * n, None)
    told = np.isfinite(theta.believed[0])
    usual = np.array([EFFECT_STD.get(x.name, x.learned_std) for x in theta.effects])
    own = np.where(told, theta.believed[1], usual[:, None] * theta.drums)
    if documented is None:
        bodies = np.tile(neutral_body(), (n, 1))
        bodies_std, load_std = np.outer(theta.body_spread[-1 - n : -1], PRIOR_STD), np.zeros(10)
    else:
        bodies = documented
        bodies_std, load_std = theta_prior(documented, DOCUMENTED_SHARE), LOAD_STD
    std = np.concatenate([load_std, spare * LOAD_STD, bodies_std.ravel(), own.ravel()])
    start = np.zeros(len(std))
    start[links], start[effects] = bodies.ravel(), np.nan_to_num(theta.believed[0]).ravel()
    positive = np.zeros(len(std), dtype=bool)
    above = np.array([x.key in x.positive for x in theta.effects], dtype=bool)
    positive[effects] = ~told.ravel() & np.repeat(above, n)

    # the learner's parameters by these: of the links, of the spare body in the hand's place
    way, hand = np.zeros((theta.P, len(std))), theta.hand
    way[theta.spare.start - 10 * n : theta.spare.start, links] = np.eye(10 * n)
    way[hand, :10] = np.eye(10)
    way[theta.spare] = way[hand]
    way[theta.spare, 10:20] = np.eye(10)
    way[theta.spare.stop :, effects] = np.eye(own.size)
    memory = np.full(n, MEMORY_S[0]) if memory_s is None else memory_s
    sums, counts = _sums(theta, way, way @ start), np.maximum(theta.moments.counts, 1.0)
    nowhere = np.zeros((0, n, len(std))), np.zeros((0, n))
    moments = Moments(period_s, counts, *sums, nowhere)
    part = Part(moments, np.arange(len(std)), np.ones(n, dtype=bool), memory)
    worth, before = min(theta.noise_gain * period_s / float(memory.mean()), 1.0), None
    if spare:  # what was told before the change, counted as what came after it is
        H, rhs = (worth * x for x in theta.told_before())
        before = way.T @ H @ way, way.T @ (rhs - H @ (way @ start))
    found = judge([part], std, positive, before)
    x, covariance = start + found.x, found.covariance
    whole = np.zeros((10 * n + own.size, len(std)))  # by these: links with what the hand carries
    whole[: 10 * n, links], whole[10 * n :, effects] = np.eye(10 * n), np.eye(own.size)
    at_hand = hand.start - theta.spare.start + 10 * n + np.arange(10)
    whole[np.ix_(at_hand, np.arange(10))] = np.eye(10)
    whole[np.ix_(at_hand, np.arange(10, 20))] = spare * np.eye(10)
    in_use = (10 * theta.in_use[:, None] + np.arange(10)).ravel()
    return LearnedPosterior(
        x[effects].reshape(own.shape),
        np.sqrt(np.diagonal(covariance)[effects]).reshape(own.shape),
        (x[:10], covariance[:10, :10]),
        (x[10:20], covariance[10:20, 10:20]) if spare else None,
        theta.covariance()[np.ix_(in_use, in_use)] / worth,
        whole @ covariance @ whole.T,
    )


def _sums(theta: Theta, way: Array, start: Array) -> tuple[Array, Array, Array, Array]:
    """`judgement.posterior.Moments` of one segment: squares, products, size, the model's square.

    Args:
        way: (P, c) of the learner's parameters by coefficient; start: (P,) with all at zero.
    """
    n, c = theta.tree.n, way.shape[1]
    squares, products = np.zeros((n, c, c)), np.zeros((n, c))
    size, model = np.zeros((2, n))
    for j, count in enumerate(theta.rows.sizes):
        place, share = theta.rows.place[j, :count], theta.rows.share[j, :count, None]
        own, at_start = share * way[place], share[:, 0] * start[place]
        whole = theta.joint_moments(j)
        Y, y = whole[:count, :count], whole[:count, count]
        squares[j], products[j] = own.T @ Y @ own, own.T @ (y - Y @ at_start)
        model[j] = at_start @ Y @ at_start
        size[j] = whole[count, count] - 2.0 * at_start @ y + model[j]
    return squares, products, size, model
