"""Which joint and which parent may move a link, and how well each pair explains its motion.

The score of a hypothesis is a log likelihood whose residuals are held against the noise that is
known: zero while the misfit is what noise makes, falling with the logarithm of the misfit beyond
it. It counts as many independent samples as the motion itself is worth, which is far fewer than
were recorded, because what a wrong hypothesis leaves moves as slowly as the arm. So equals tie.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from adapter.discovery.bodies import NO_JOINT, Bodies
from adapter.discovery.mounting import Mounting
from adapter.discovery.placement import angular_misfit, linear_misfit, place
from adapter.spatial import Array

FREE = -1  # parent of a link that nothing in the recording carries
ALLOWANCE = 1.3  # misfit over expected variance that noise levels known so roughly may show ...
DEVIATIONS = 4.0  # ... and so many standard deviations of a mean square of the noise
FREE_RATIO = 4.0  # a link goes free where all explain it worse than by so many noise variances
FREE_PRIOR = -5.0  # log odds of a link whose carrier is not in the recording
RIGID_PRIOR = -5.0  # log odds of a link without a joint of its own
MOST_FITTED = 48  # hypotheses of a link whose frame is fitted; with more of them nothing is decided
MOST_KEPT = 200  # options of a link
LOST = 18.0  # log odds below the best at which a hypothesis is dropped


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
    mounting: Mounting | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Hypotheses:
    """Options of every link, best first, the free one last among equals.

    Attributes:
        bodies: what they are about.
        options: by link.
        mounted: whether frames may be any.
        excess: by channel, how many times larger than the noise says the misfit of all links is.
        tolerance: ratio of misfit to expected variance that still counts as noise.
    """

    bodies: Bodies
    options: tuple[tuple[Option, ...], ...]
    excess: dict[str, float]
    tolerance: float
    mounted: bool = False


Fits = dict[tuple[int, int], dict[str, float]]  # misfits by channel of (joint column, parent)


def hypotheses_of(bodies: Bodies, misfit: dict[str, Array]) -> Hypotheses:
    """Every option that is not far worse than a link that nothing carries, axes being z.

    Args:
        bodies: what they are about.
        misfit: bounds as of `convention_misfit`.
    """
    ruler = Ruler(bodies)
    ruler.learn_excess(least_ratios(ruler, misfit))
    fits = convention_fits(ruler, misfit)
    linear = [k for k in bodies.channels if k in ("v", "a")]
    ratios = [best_ratios(ruler.ratios(j, found)) for j, found in enumerate(fits) if found]
    if ratios:
        ruler.learn_excess({k: np.array([r[k] for r in ratios]) for k in linear})
    options = tuple(
        ranked(convention_options(ruler, j, fits[j], misfit), ruler, j) for j in range(bodies.links)
    )
    return Hypotheses(bodies, options, ruler.excess, ruler.tolerance)


def keeps_convention(bodies: Bodies, misfit: dict[str, Array]) -> bool:
    """Whether most links may turn about their z: their bounds are about what noise makes."""
    ruler = Ruler(bodies)
    ruler.learn_excess(least_ratios(ruler, misfit))
    return max(ruler.excess.values()) <= FREE_RATIO


def least_ratios(ruler: Ruler, misfit: dict[str, Array]) -> dict[str, Array]:
    """Least ratio of bound to expected variance, by channel and link."""
    return {k: (misfit[k] / ruler.variance[k]).min(axis=(1, 2)) for k in misfit}


def convention_misfit(bodies: Bodies) -> dict[str, Array]:
    """Mean squares (links, joints + 1, bodies) that no frame whose z is the axis goes below.

    The last joint is none; infinite where it cannot be. What rests is moved by no joint that moves.
    """
    joints = np.append(np.arange(bodies.recorded.q.shape[1]), NO_JOINT)
    misfit = {**angular_misfit(bodies, joints), **linear_misfit(bodies, joints)}
    moving = np.append(~bodies.resting, False)
    for x in misfit.values():
        for j in range(bodies.links):
            x[j, :, j] = np.inf
            if bodies.at_rest[j]:
                x[j, moving] = np.inf
    return misfit


def convention_fits(ruler: Ruler, misfit: dict[str, Array]) -> list[Fits]:
    """By link, misfits of fitted frames whose z is the axis."""
    bound = ruler.total({k: misfit[k] / ruler.variance[k] for k in misfit})
    worst = ruler.free_score() - LOST
    return [_fits(ruler, j, promising(part, worst)) for j, part in enumerate(bound)]


def promising(bound: Array, worst: float, most: int = MOST_FITTED) -> list[tuple[int, int]]:
    """(joint column, parent) of what may still score well; at least one."""
    best_first = np.argsort(-bound, axis=None, kind="stable")[:most]
    best_first = best_first[np.isfinite(bound.ravel()[best_first])]
    keep = bound.ravel()[best_first] >= min(worst, float(bound.max()))
    rows, columns = np.unravel_index(best_first[keep], bound.shape)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def _fits(ruler: Ruler, link: int, where: list[tuple[int, int]]) -> Fits:
    """Fitted frames; joints at rest share theirs, which differ by a constant turn only."""
    bodies, joints = ruler.bodies, ruler.joints
    shared: dict[int, dict[str, float]] = {}
    out = {}
    for s, i in where:
        joint = int(joints[s])
        resting = joint == NO_JOINT or bool(bodies.resting[joint])
        if resting and i in shared:
            out[s, i] = shared[i]
            continue
        out[s, i] = place(bodies, link, joint, i, ruler.of(link, s, i)).misfit
        if resting:
            shared[i] = out[s, i]
    return out


def best_ratios(ratios: list[dict[str, float]]) -> dict[str, float]:
    """By channel, of the option that is best in all of them together."""
    return min(ratios, key=lambda r: sum(np.log1p(x) for x in r.values()), default={})


def convention_options(
    ruler: Ruler, link: int, fits: Fits, misfit: dict[str, Array]
) -> list[Option]:
    """Fitted ones with their score; those that were too many to fit with their bound."""
    worst = ruler.free_score() - LOST
    bound = ruler.total({k: misfit[k][link] / ruler.variance[k][link] for k in misfit})
    found = []
    for s, i in zip(*np.nonzero(bound >= worst), strict=True):
        at = int(s), int(i)
        score = ruler.total(ruler.ratios(link, {at: fits[at]})[0]) if at in fits else bound[at]
        joint = int(ruler.joints[s])
        score += RIGID_PRIOR if joint == NO_JOINT else 0.0
        if score >= worst:
            found.append(Option(link, joint, int(i), float(score)))
    return found


def ranked(found: list[Option], ruler: Ruler, link: int, prior: float = 0.0) -> tuple[Option, ...]:
    """The best of them and the free one, best first; `prior` is added for a free link.

    A base that was named is free and nothing else.
    """
    if link == ruler.bodies.base:
        return (Option(link, NO_JOINT, FREE, 0.0),)
    best = sorted(found, key=lambda o: -o.score)[:MOST_KEPT]
    free = Option(link, NO_JOINT, FREE, ruler.free_score() + prior)
    return tuple(sorted([*best, free], key=lambda o: (-o.score, o.parent == FREE)))


class Ruler:
    """Expected variances, and the log likelihood of a misfit."""

    def __init__(self, bodies: Bodies) -> None:
        recorded = bodies.recorded
        self.bodies = bodies
        self.joints = np.append(np.arange(recorded.q.shape[1]), NO_JOINT)
        self.variance = {k: bodies.variance(k, self.joints) for k in bodies.channels}
        self.excess = dict.fromkeys(bodies.channels, 1.0)
        spread = np.sqrt(2.0 / (3.0 * recorded.noise_samples))
        self.tolerance = ALLOWANCE + DEVIATIONS * float(spread)
        self._samples = 3.0 * recorded.motion_samples

    def of(self, link: int, column: int, parent: int) -> dict[str, float]:
        """Expected variance by channel of one hypothesis."""
        return {k: float(v[link, column, parent]) for k, v in self.variance.items()}

    def ratios(self, link: int, fits: Fits) -> list[dict[str, float]]:
        """Misfit over expected variance, by channel, of each fit of a link."""
        found = []
        for (s, i), misfit in fits.items():
            of = self.of(link, s, i)
            found.append({k: misfit[k] / of[k] for k in of})
        return found

    def learn_excess(self, ratios: dict[str, Array]) -> None:
        """Take for noise what the best explanations of most links leave over alike.

        Such a misfit (of late sensors, say) is no white noise, so each sample, of all channels,
        counts the less, the larger it is.
        """
        for k, x in ratios.items():
            self.excess[k] = max(1.0, float(np.median(x[np.isfinite(x)])))

    def score(self, channel: str, ratio: Array) -> Array:
        """Log likelihood (...) of ratios (...) of misfit to expected variance."""
        beyond = np.maximum(ratio / (self.excess[channel] * self.tolerance), 1.0)
        return np.asarray(-0.5 * self._worth() * np.log(beyond))

    def total(self, ratios: Mapping[str, Array | float]) -> Array:
        """Log likelihood (...) of all channels together."""
        return np.asarray(sum(self.score(k, np.asarray(x)) for k, x in ratios.items()))

    def free_score(self) -> float:
        """What a link costs that nothing carries."""
        beyond = np.log(max(FREE_RATIO / self.tolerance, 1.5))
        return FREE_PRIOR - 0.5 * float(len(self.excess) * self._worth() * beyond)

    def _worth(self) -> float:
        """Independent samples of a channel; what is no noise in one reaches into the others."""
        return self._samples / max(self.excess.values())
