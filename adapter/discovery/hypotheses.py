"""Which joint and which parent may move a link, and how well each pair explains its motion.

The score of a hypothesis is a log likelihood whose residuals are held against the noise that is
known: zero while the misfit is what noise makes, falling with the logarithm of the misfit beyond
it. It counts as many independent samples as the motion itself is worth, which is far fewer than
were recorded, because what a wrong hypothesis leaves moves as slowly as the arm. So equals tie.

A frame that turns about its z with its origin on the axis is believed to be meant so; a sensor
mounted anyhow does so only by accident. So an axis that had to be found costs a link a little,
which decides nothing where links are left unexplained else, and the direction of edges where
the frames of some links keep the convention. Without those, a pair looks the same from both sides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from adapter.discovery import frames
from adapter.discovery.axes import Axes, axes_of
from adapter.discovery.bodies import LEVER_M, NO_JOINT, Bodies
from adapter.model.spatial import Array

FREE = -1  # parent of a link that nothing in the recording carries
ALLOWANCE = 1.3  # misfit over expected variance that noise levels known so roughly may show ...
DEVIATIONS = 4.0  # ... and so many standard deviations of a mean square of the noise
FREE_RATIO = 4.0  # a link goes free where all explain it worse than by so many noise variances
# Log odds of what is rare: a link whose carrier is not in the recording, one without a joint of its
# own, a frame that does not turn about its z.
RARE_PRIOR = -5.0
MOST_FITTED = 48  # hypotheses of a link whose frame is fitted; with more of them nothing is decided
MOST_MOUNTED = 24  # pairs of a link that are fitted; with more of them nothing is decided
LOST = 18.0  # log odds below the best at which a hypothesis is dropped
Fits = dict[tuple[int, int], dict[str, float]]  # misfits by channel of (joint column, parent)
Pair = tuple[int, int, int]  # joint, and two bodies of which the first is a link and moves


@dataclass(frozen=True)
class Option:
    """One explanation of a link's motion.

    Attributes:
        link: index; joint: index or NO_JOINT; parent: body index or FREE.
        score: log likelihood, 0 where the misfit is mere noise.
        mounting: where the joint's axis lies in the link's frame; None where it is z by convention
            and where there is none.
    """

    link: int
    joint: int
    parent: int
    score: float
    mounting: frames.Mounting | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Hypotheses:
    """Options of every link, best first, the free one last among equals.

    Attributes:
        bodies: what they are about.
        options: by link.
        mounted: whether frames may be any.
        excess: by channel, how many times larger than the noise says the misfit of all links is.
    """

    bodies: Bodies
    options: tuple[tuple[Option, ...], ...]
    excess: dict[str, float]
    mounted: bool = False


def hypotheses_of(bodies: Bodies, misfit: dict[str, Array]) -> Hypotheses:
    """Every option that is not far worse than a link that nothing carries, axes being z.

    Args:
        bodies: what they are about.
        misfit: bounds as of `convention_misfit`.
    """
    scores = Scores(bodies)
    scores.learn_excess(least_ratios(scores, misfit))
    fits = convention_fits(scores, misfit)
    linear = [k for k in bodies.channels if k in ("v", "a")]
    ratios = [best_ratios(scores.ratios(j, found)) for j, found in enumerate(fits) if found]
    if ratios:
        scores.learn_excess({k: np.array([r[k] for r in ratios]) for k in linear})
    found = (convention_options(scores, j, fits[j], misfit) for j in range(bodies.links))
    options = tuple(ranked(own, scores, j) for j, own in enumerate(found))
    return Hypotheses(bodies, options, scores.excess)


def keeps_convention(bodies: Bodies, misfit: dict[str, Array]) -> bool:
    """Whether most links may turn about their z: their bounds are about what noise makes."""
    scores = Scores(bodies)
    scores.learn_excess(least_ratios(scores, misfit))
    return max(scores.excess.values()) <= FREE_RATIO


def least_ratios(scores: Scores, misfit: dict[str, Array]) -> dict[str, Array]:
    """Least ratio of bound to expected variance, by channel and link."""
    return {k: (misfit[k] / scores.variance[k]).min(axis=(1, 2)) for k in misfit}


def convention_misfit(bodies: Bodies) -> dict[str, Array]:
    """Mean squares (links, joints + 1, bodies) that no frame whose z is the axis goes below.

    The last joint is none; infinite where it cannot be. What rests is moved by no joint that moves.
    """
    joints = np.append(np.arange(bodies.log.q.shape[1]), NO_JOINT)
    misfit = {**frames.angular_misfit(bodies, joints), **frames.linear_misfit(bodies, joints)}
    moving = np.append(~bodies.resting, False)
    for x in misfit.values():
        for j in range(bodies.links):
            x[j, :, j] = np.inf
            if bodies.at_rest[j]:
                x[j, moving] = np.inf
    return misfit


def convention_fits(scores: Scores, misfit: dict[str, Array]) -> list[Fits]:
    """By link, misfits of fitted frames whose z is the axis."""
    bound = scores.total({k: misfit[k] / scores.variance[k] for k in misfit})
    worst = scores.free_score() - LOST
    return [_fits(scores, j, promising(part, worst)) for j, part in enumerate(bound)]


def promising(bound: Array, worst: float, most: int = MOST_FITTED) -> list[tuple[int, int]]:
    """(joint column, parent) of what may still score well; at least one."""
    best_first = np.argsort(-bound, axis=None, kind="stable")[:most]
    best_first = best_first[np.isfinite(bound.ravel()[best_first])]
    keep = bound.ravel()[best_first] >= min(worst, float(bound.max()))
    rows, columns = np.unravel_index(best_first[keep], bound.shape)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def _fits(scores: Scores, link: int, where: list[tuple[int, int]]) -> Fits:
    """Fitted frames; joints at rest share theirs, which differ by a constant turn only."""
    bodies, joints = scores.bodies, scores.joints
    shared: dict[int, dict[str, float]] = {}
    out = {}
    for s, i in where:
        joint = int(joints[s])
        resting = joint == NO_JOINT or bool(bodies.resting[joint])
        if resting and i in shared:
            out[s, i] = shared[i]
            continue
        out[s, i] = frames.misfit_about_z(bodies, (link, i), joint, scores.of(link, s, i))
        if resting:
            shared[i] = out[s, i]
    return out


def best_ratios(ratios: list[dict[str, float]]) -> dict[str, float]:
    """By channel, of the option that is best in all of them together."""
    return min(ratios, key=lambda r: sum(np.log1p(x) for x in r.values()), default={})


def convention_options(
    scores: Scores, link: int, fits: Fits, misfit: dict[str, Array]
) -> list[Option]:
    """Fitted ones with their score; those that were too many to fit with their bound."""
    worst = scores.free_score() - LOST
    bound = scores.total({k: misfit[k][link] / scores.variance[k][link] for k in misfit})
    found = []
    for s, i in zip(*np.nonzero(bound >= worst), strict=True):
        at = int(s), int(i)
        score = scores.total(scores.ratios(link, {at: fits[at]})[0]) if at in fits else bound[at]
        joint = int(scores.joints[s])
        score += RARE_PRIOR if joint == NO_JOINT else 0.0
        if score >= worst:
            found.append(Option(link, joint, int(i), float(score)))
    return found


def ranked(
    found: list[Option], scores: Scores, link: int, prior: float = 0.0
) -> tuple[Option, ...]:
    """The best of them and the free one, best first; `prior` is added for a free link.

    A base that was named is free and nothing else.
    """
    if link == scores.bodies.base:
        return (Option(link, NO_JOINT, FREE, 0.0),)
    best = sorted(found, key=lambda o: -o.score)[:200]  # options of a link
    free = Option(link, NO_JOINT, FREE, scores.free_score() + prior)
    return tuple(sorted([*best, free], key=lambda o: (-o.score, o.parent == FREE)))


class Scores:
    """Expected variances, and the log likelihood of a misfit.

    `tolerance`: ratio of misfit to expected variance that still counts as noise.
    """

    def __init__(self, bodies: Bodies) -> None:
        log = bodies.log
        self.bodies = bodies
        self.joints = np.append(np.arange(log.q.shape[1]), NO_JOINT)
        self.variance = {k: bodies.variance(k, self.joints) for k in bodies.channels}
        self.excess = dict.fromkeys(bodies.channels, 1.0)
        spread = np.sqrt(2.0 / (3.0 * log.noise_samples))
        self.tolerance = ALLOWANCE + DEVIATIONS * float(spread)
        # independent samples that the motion itself is worth
        self._samples = 3.0 * max(1.0, 2.0 * log.duration_s * log.motion_hz)

    def of(self, link: int, column: int, parent: int) -> dict[str, float]:
        """Expected variance by channel of one hypothesis."""
        return {k: float(v[link, column, parent]) for k, v in self.variance.items()}

    def ratios(self, link: int, fits: Fits) -> list[dict[str, float]]:
        """Misfit over expected variance, by channel, of each fit of a link."""
        pairs = ((self.of(link, s, i), misfit) for (s, i), misfit in fits.items())
        return [{k: misfit[k] / of[k] for k in of} for of, misfit in pairs]

    def learn_excess(self, ratios: dict[str, Array]) -> None:
        """Take for noise what the best explanations of most links leave over alike.

        Such a misfit (of late sensors, say) is no white noise, so each sample, of all channels,
        counts the less, the larger it is.
        """
        for k, x in ratios.items():
            self.excess[k] = max(1.0, float(np.median(x[np.isfinite(x)])))

    def total(self, ratios: Mapping[str, Array | float]) -> Array:
        """Log likelihood (...) of ratios (...) of misfit to expected variance, of all channels."""
        levels = {k: self.excess[k] * self.tolerance for k in ratios}
        beyond = (np.log(np.maximum(x / levels[k], 1.0)) for k, x in ratios.items())
        return np.asarray(-0.5 * self._worth() * sum(beyond))

    def free_score(self) -> float:
        """What a link costs that nothing carries."""
        beyond = np.log(max(FREE_RATIO / self.tolerance, 1.5))
        return RARE_PRIOR - 0.5 * float(len(self.excess) * self._worth() * beyond)

    def _worth(self) -> float:
        """Independent samples of a channel; what is no noise in one reaches into the others."""
        return self._samples / max(self.excess.values())


# --- with free axes ----------------------------------------------------------------------------


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
    scores = Scores(bodies)
    pairs = _pairs_of(scores)
    least = least_ratios(scores, misfit)
    for k, x in pairs.ratio.items():
        least[k] = np.minimum(least[k], x.min(axis=(0, 2)))
    scores.learn_excess({k: x for k, x in least.items() if k in pairs.ratio})
    kept = convention_fits(scores, misfit)
    fits = _fitted(scores, pairs)
    best = []
    for j in range(bodies.links):
        own = [_ratios(pairs, at, fit) for at, fit in fits.items() if j in at[1:]]
        best.append(best_ratios(own + scores.ratios(j, kept[j])))
    best = [ratios for ratios in best if ratios]
    scores.learn_excess({k: np.array([ratios[k] for ratios in best]) for k in bodies.channels})
    found = [convention_options(scores, j, kept[j], misfit) for j in range(bodies.links)]
    _add_mounted(found, scores, pairs, fits)
    options = []
    for j, every in enumerate(found):
        single: dict[tuple[int, int], Option] = {}  # of those that differ in the mounting the best
        for option in sorted(every, key=lambda o: -o.score):
            single.setdefault((option.joint, option.parent), option)
        options.append(ranked(list(single.values()), scores, j, RARE_PRIOR))
    return Hypotheses(bodies, tuple(options), scores.excess, True)


def _pairs_of(scores: Scores) -> _Pairs:
    bodies = scores.bodies
    variance = {}
    for k, x in scores.variance.items():
        both = x[:, :-1].transpose(1, 0, 2).copy()
        for name, by in (("v", "w"), ("a", "dw")):
            if name == k:
                both += (2.0 / 3.0) * LEVER_M**2 * bodies.noise[by][: bodies.links, None]
        own = both[:, :, : bodies.links]
        own[:] = 0.5 * (own + own.transpose(0, 2, 1))
        variance[k] = both
    axes = axes_of(bodies, scores.variance)
    ratio = {}
    for k, x in axes.misfit.items():
        ratio[k] = x / (3.0 * variance[k])  # one of three components
        ratio[k][bodies.resting] = np.inf
        ratio[k][:, bodies.at_rest] = np.inf
        ratio[k][:, np.arange(bodies.links), np.arange(bodies.links)] = np.inf
    return _Pairs(axes, variance, ratio)


def _fitted(scores: Scores, pairs: _Pairs) -> dict[Pair, frames.PairFit]:
    """Each promising pair once, the link with the lower number first."""
    bodies = scores.bodies
    bound = scores.total(pairs.ratio)
    wanted: set[Pair] = set()
    for j in np.flatnonzero(~bodies.at_rest).tolist():
        for s, i in promising(bound[:, j], scores.free_score() - LOST, MOST_MOUNTED):
            swap = i < j and not bodies.at_rest[i]
            wanted.add((s, i, j) if swap else (s, j, i))
    return {at: _fit(scores, pairs, at) for at in sorted(wanted)}


def _fit(scores: Scores, pairs: _Pairs, at: Pair) -> frames.PairFit:
    """A pair's fit; begun at its other link too where the first leaves more than noise.

    Both sides have the same minimum, but not the same ways into others.
    """
    s, j, i = at
    of = {k: float(x[at]) for k, x in pairs.variance.items()}
    fit = frames.mount(scores.bodies, (j, i), s, pairs.axes.axis[at], of)
    if i >= scores.bodies.links or scores.total(_ratios(pairs, at, fit)) >= 0.0:
        return fit
    other = frames.mount(scores.bodies, (i, j), s, pairs.axes.axis[s, i, j], of)
    if sum(other.misfit[k] / of[k] for k in of) >= sum(fit.misfit[k] / of[k] for k in of):
        return fit
    return frames.PairFit(other.parent, other.child, other.misfit)


def _ratios(pairs: _Pairs, at: Pair, fit: frames.PairFit) -> dict[str, float]:
    return {k: fit.misfit[k] / float(x[at]) for k, x in pairs.variance.items()}


def _add_mounted(
    found: list[list[Option]], scores: Scores, pairs: _Pairs, fits: dict[Pair, frames.PairFit]
) -> None:
    """Options of both ends of each pair; with its bound where it was not fitted."""
    worst = scores.free_score() - LOST
    bound = scores.total(pairs.ratio)
    for s, j, i in zip(*np.nonzero(bound >= worst), strict=True):
        at = int(s), int(j), int(i)
        mirror = at[0], at[2], at[1]
        score, mounting = float(bound[at]), None
        if at in fits:
            score, mounting = float(scores.total(_ratios(pairs, at, fits[at]))), fits[at].child
        elif mirror in fits:
            score = float(scores.total(_ratios(pairs, mirror, fits[mirror])))
            mounting = fits[mirror].parent
        if score >= worst:
            found[at[1]].append(Option(at[1], at[0], at[2], score + RARE_PRIOR, mounting))
