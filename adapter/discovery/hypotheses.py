"""Which joint and which parent may move a link, and how well each pair explains its motion.

The score of a hypothesis is a log likelihood whose residuals are held against the noise that is
known: zero while the misfit is what noise makes, falling with the logarithm of the misfit beyond
it. It counts as many independent samples as the motion itself is worth, which is far fewer than
were recorded, because what a wrong hypothesis leaves moves as slowly as the arm. So equals tie.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from adapter.discovery.bodies import NO_JOINT, Bodies
from adapter.discovery.placement import Placement, angular_misfit, linear_misfit, place
from adapter.spatial import Array

FREE = -1  # parent of a link that nothing in the recording carries
ALLOWANCE = 1.3  # misfit over expected variance that noise levels known so roughly may show ...
DEVIATIONS = 4.0  # ... and so many standard deviations of a mean square of the noise
FREE_RATIO = 4.0  # a link goes free where all explain it worse than by so many noise variances
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
        fit: frame and misfit; None where the link is free.
    """

    link: int
    joint: int
    parent: int
    score: float
    fit: Placement | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Hypotheses:
    """Options of every link, best first, the free one last among equals.

    Attributes:
        bodies: what they are about.
        options: by link.
        excess: by channel, how many times larger than the noise says the misfit of all links is.
        tolerance: ratio of misfit to expected variance that still counts as noise.
    """

    bodies: Bodies
    options: tuple[tuple[Option, ...], ...]
    excess: dict[str, float]
    tolerance: float


def hypotheses_of(bodies: Bodies) -> Hypotheses:
    """Every option that is not far worse than a link that nothing carries."""
    joints = np.append(np.arange(bodies.recorded.q.shape[1]), NO_JOINT)
    ruler = _Ruler(bodies, joints)
    misfit = {**angular_misfit(bodies, joints), **linear_misfit(bodies, joints)}
    for j in range(bodies.links):
        for k in misfit:
            misfit[k][j, :, j] = np.inf
    ruler.learn_excess({k: (misfit[k] / ruler.variance[k]).min(axis=(1, 2)) for k in misfit})
    bound = np.sum([ruler.score(k, misfit[k] / ruler.variance[k]) for k in misfit], axis=0)
    fits = [_fits(ruler, j, where) for j, where in enumerate(_promising(bound, ruler))]
    linear = [k for k in bodies.channels if k in ("v", "a")]
    if linear:
        ruler.learn_excess({k: _best_ratios(fits, ruler, k) for k in linear})
    bound = np.sum([ruler.score(k, misfit[k] / ruler.variance[k]) for k in misfit], axis=0)
    options = tuple(_options(j, fits[j], bound[j], ruler) for j in range(bodies.links))
    return Hypotheses(bodies, options, ruler.excess, ruler.tolerance)


def _promising(bound: Array, ruler: _Ruler) -> list[list[tuple[int, int]]]:
    """(joint column, parent) of what may still score well; of each link at least one."""
    worst = ruler.free_score() - LOST
    found = []
    for part in bound:
        best_first = np.argsort(-part, axis=None, kind="stable")[:MOST_FITTED]
        keep = part.ravel()[best_first] >= min(worst, float(part.max()))
        rows, columns = np.unravel_index(best_first[keep], part.shape)
        found.append(list(zip(rows.tolist(), columns.tolist(), strict=True)))
    return found


def _fits(
    ruler: _Ruler, link: int, where: list[tuple[int, int]]
) -> dict[tuple[int, int], Placement]:
    """Fitted frames; joints at rest share theirs, which differ by a constant turn only."""
    bodies, joints = ruler.bodies, ruler.joints
    shared: dict[int, Placement] = {}
    out = {}
    for s, i in where:
        joint = int(joints[s])
        resting = joint == NO_JOINT or bool(bodies.resting[joint])
        if resting and i in shared:
            out[s, i] = shared[i]
            continue
        out[s, i] = place(bodies, link, joint, i, ruler.of(link, s, i))
        if resting:
            shared[i] = out[s, i]
    return out


def _best_ratios(
    fits: list[dict[tuple[int, int], Placement]], ruler: _Ruler, channel: str
) -> Array:
    """(links,) ratio in one channel of the option that is best in all of them together."""
    best = []
    for j, found in enumerate(fits):
        ratios = []
        for (s, i), fit in found.items():
            of = ruler.of(j, s, i)
            ratios.append({k: fit.misfit[k] / of[k] for k in of})
        best.append(min(ratios, key=lambda r: sum(np.log1p(x) for x in r.values()))[channel])
    return np.array(best)


def _options(
    link: int, fits: dict[tuple[int, int], Placement], bound: Array, ruler: _Ruler
) -> tuple[Option, ...]:
    """Fitted ones with their score; those that were too many to fit with their bound."""
    worst = ruler.free_score() - LOST
    found = []
    for s, i in zip(*np.nonzero(bound >= worst), strict=True):
        fit = fits.get((int(s), int(i)))
        score = float(bound[s, i])
        if fit is not None:
            of = ruler.of(link, s, i)
            score = sum(float(ruler.score(k, np.array(fit.misfit[k] / of[k]))) for k in of)
        joint = int(ruler.joints[s])
        score += RIGID_PRIOR if joint == NO_JOINT else 0.0
        if score >= worst:
            found.append(Option(link, joint, int(i), score, fit))
    best = sorted(found, key=lambda o: -o.score)[:MOST_KEPT]
    free = Option(link, NO_JOINT, FREE, ruler.free_score())
    return tuple(sorted([*best, free], key=lambda o: (-o.score, o.parent == FREE)))


class _Ruler:
    """Expected variances, and the log likelihood of a misfit."""

    def __init__(self, bodies: Bodies, joints: np.ndarray) -> None:
        recorded = bodies.recorded
        self.bodies, self.joints = bodies, joints
        self.variance = {k: bodies.variance(k, joints) for k in bodies.channels}
        self.excess = dict.fromkeys(bodies.channels, 1.0)
        spread = np.sqrt(2.0 / (3.0 * recorded.noise_samples))
        self.tolerance = ALLOWANCE + DEVIATIONS * float(spread)
        self._samples = 3.0 * recorded.motion_samples

    def of(self, link: int, column: int, parent: int) -> dict[str, float]:
        """Expected variance by channel of one hypothesis."""
        return {k: float(v[link, column, parent]) for k, v in self.variance.items()}

    def learn_excess(self, ratios: dict[str, Array]) -> None:
        """Take for noise what the best explanations of most links leave over alike.

        Such a misfit is no white noise, so each sample counts the less, the larger it is.
        """
        for k, x in ratios.items():
            self.excess[k] = max(1.0, float(np.median(x)))

    def score(self, channel: str, ratio: Array) -> Array:
        """Log likelihood (...) of ratios (...) of misfit to expected variance."""
        beyond = np.maximum(ratio / (self.excess[channel] * self.tolerance), 1.0)
        return np.asarray(-0.5 * self._worth(channel) * np.log(beyond))

    def free_score(self) -> float:
        """What a link costs that nothing carries."""
        beyond = np.log(max(FREE_RATIO / self.tolerance, 1.5))
        return -0.5 * float(sum(self._worth(k) for k in self.excess) * beyond)

    def _worth(self, channel: str) -> float:
        return self._samples / self.excess[channel]
