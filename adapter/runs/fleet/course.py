"""How numbers of recordings go over time and over what a manifest tells, and which stand out.

Each recording gives friction and offsets with standard deviations; these say which is surer, not
how sure. A line through them is held against what it leaves (Student's t), its chance multiplied
by how many were tried (Bonferroni). How much one parameter's few numbers scatter is told by those
of all parameters (moderated t: G. K. Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import digamma, polygamma
from scipy.stats import t as student

from adapter.model.spatial import Array

FEWEST = 5  # numbers that a line, or what stands out beside others, takes
CHANCE = 0.01  # of one false alarm among all that is asked of an arm
TINY = 1e-300
Used = Sequence[NDArray[np.bool_]]


class Series(NamedTuple):
    """A parameter of a joint in each recording.

    Attributes:
        effect, joint: of which joint (from 1).
        values, std: (m,) and standard deviations.
    """

    effect: str
    joint: int
    values: Array
    std: Array


@dataclass(frozen=True)
class Drift:
    """A parameter that follows something.

    Attributes:
        effect, joint: of which joint (from 1).
        follows: "time", or a column of the manifest.
        slope, std: of the parameter per day, or per unit of the column.
        span: how far the parameter goes over all recordings.
        usual: its mean.
        chance: of a line as clear as this one where there is none, times all that were tried.
        rivals: columns that explain it too; these recordings cannot tell which it is.
    """

    effect: str
    joint: int
    follows: str
    slope: float
    std: float
    span: float
    usual: float
    chance: float
    rivals: tuple[str, ...] = ()


class StandsOut(NamedTuple):
    """A parameter that one recording has otherwise than the others.

    Attributes:
        number: of the recording.
        effect, joint: of which joint (from 1).
        value: there; expected: from the others.
    """

    number: int
    effect: str
    joint: int
    value: float
    expected: float


def courses(
    series: Sequence[Series], columns: Mapping[str, Array]
) -> tuple[list[Drift], list[StandsOut]]:
    """What drifts, the clearest first, and what stands out.

    Args:
        series: all parameters of an arm.
        columns: (m,) what they may follow, NaN where nobody told.
    """
    use = [np.isfinite(x.values) & (x.std > 0.0) for x in series]
    drifts = _drifts(series, columns, use)
    by: dict[tuple[str, int], list[Array]] = {}
    for x in drifts:
        by.setdefault((x.effect, x.joint), []).append(columns[x.follows])
    follows = [by.get((one.effect, one.joint), []) for one in series]
    out: list[StandsOut] = []
    while farthest := list(_standing_out(series, follows, use)):
        for k, found in farthest:  # another one may have hidden behind it
            use[k][found.number] = False
            out.append(found)
    if out:  # a line may have gone through those alone, or they have hidden one
        drifts = _drifts(series, columns, use)
    return drifts, out


def _drifts(series: Sequence[Series], columns: Mapping[str, Array], use: Used) -> list[Drift]:
    found: list[list[Drift]] = [[] for _ in series]
    for name, x in columns.items():
        on = [ours & np.isfinite(x) for ours in use]
        fits = [_fit(*each) for each in zip(series, [[x]] * len(series), on, strict=True)]
        usual = Usual.of(fits)
        for one, ours, fit, own in zip(series, on, fits, found, strict=True):
            if fit is None or len(fit.left) < FEWEST:
                continue
            chance = len(series) * len(columns) * float(usual.chances(fit)[1])
            if chance < CHANCE:
                slope, std = float(fit.found[1]), float(usual.stds(fit)[1])
                span = abs(slope) * float(np.ptp(x[ours]))
                mean = float(np.average(one.values[ours], weights=one.std[ours] ** -2.0))
                drift = Drift(one.effect, one.joint, name, slope, std, span, mean, chance)
                own.append(drift)
    apart: list[Drift] = []
    for one, own, ours in zip(series, found, use, strict=True):
        apart += _told_apart(one, sorted(own, key=lambda x: x.chance), columns, ours)
    return sorted(apart, key=lambda x: (x.chance, -x.span))


def _told_apart(
    one: Series, found: list[Drift], columns: Mapping[str, Array], use: NDArray[np.bool_]
) -> Iterator[Drift]:
    """Without lines that another one explains; those that nothing tells apart become one."""
    gone: set[str] = set()
    for drift in found:
        rivals = []
        for other in found:
            if drift.follows in gone or other.follows in gone or other is drift:
                continue
            fit = _fit(one, [columns[drift.follows], columns[other.follows]], use)
            matter = [False, False]
            if fit is not None:
                matter = [x < CHANCE for x in Usual.of([fit]).chances(fit)[1:]]
            if not any(matter):
                rivals.append(other.follows)
            if not matter[1]:
                gone.add(other.follows)
            elif not matter[0]:
                gone.add(drift.follows)
        if drift.follows not in gone:
            yield replace(drift, rivals=tuple(rivals))


def _standing_out(
    series: Sequence[Series], follows: Sequence[Sequence[Array]], use: Used
) -> Iterator[tuple[int, StandsOut]]:
    """Of each parameter the recording that stands out most, against all others that are left.

    What a fit without a number foretells of it follows from the fit with it (its leverage).
    """
    fits = [_fit(*each) for each in zip(series, follows, use, strict=True)]
    usual, tests = Usual.of(fits), sum(int(ours.sum()) for ours in use)
    for k, (one, fit) in enumerate(zip(series, fits, strict=True)):
        if fit is None or fit.freedom < FEWEST - 2:
            continue
        if len(fit.left) <= 0.75 * len(one.values):  # no more may stand out
            continue
        rest = np.maximum(1.0 - fit.leverage, TINY)
        away = fit.left / rest
        others = (np.sum(fit.left**2) - fit.left * away) / (fit.freedom - 1)
        clear = np.abs(away) * np.sqrt(rest / usual.scatter(others, fit.freedom - 1))
        worst = int(np.argmax(clear))
        freedom = fit.freedom - 1 + usual.freedom
        if tests * 2.0 * float(student.sf(clear[worst], freedom)) < CHANCE:
            number = int(np.flatnonzero(use[k] & _told(follows[k], use[k]))[worst])
            value = float(one.values[number])
            expected = value - float(one.std[number] * away[worst])
            yield k, StandsOut(number, one.effect, one.joint, value, expected)


def _told(follows: Sequence[Array], use: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.all([use, *(np.isfinite(x) for x in follows)], axis=0)


class Fit(NamedTuple):
    """A weighted fit of a constant and columns.

    Attributes:
        found, alone: (1 + c,) coefficients, and their standard deviations by the numbers' own.
        left, leverage: of the numbers in use: what the fit leaves, in standard deviations of its
            own, and how far the fit follows it.
        freedom: numbers more than coefficients.
    """

    found: Array
    alone: Array
    left: Array
    leverage: Array
    freedom: int

    @property
    def scatter(self) -> float:
        """Variance of what is left, in variances of the numbers' own."""
        return max(float(self.left @ self.left) / self.freedom, TINY)


def _fit(one: Series, follows: Sequence[Array], use: NDArray[np.bool_]) -> Fit | None:
    """None where there are too few numbers, or columns that go together."""
    use = _told(follows, use)
    freedom = int(use.sum()) - 1 - len(follows)
    if use.sum() < FEWEST - 1 or freedom < 2:
        return None
    middle = np.array([np.mean(x[use]) for x in follows])
    size = np.array([np.std(x[use]) or 1.0 for x in follows])
    scaled = [(x[use] - m) / s for x, m, s in zip(follows, middle, size, strict=True)]
    rows = np.column_stack([np.ones(int(use.sum())), *scaled]) / one.std[use, None]
    sides, values, turn = np.linalg.svd(rows, full_matrices=False)
    if values[-1] <= 1e-8 * values[0]:  # of a column others leave nothing
        return None
    target = one.values[use] / one.std[use]
    back = np.diag(np.r_[1.0, 1.0 / size])  # to the columns' own units
    back[0, 1:] = -middle / size
    back = back @ turn.T / values
    left = target - sides @ (sides.T @ target)
    alone = np.sqrt(np.sum(back**2, axis=1))
    return Fit(back @ (sides.T @ target), alone, left, np.sum(sides**2, axis=1), freedom)


class Usual(NamedTuple):
    """What all parameters of an arm say of how much one scatters.

    Attributes:
        variance: the usual scatter; freedom: of how many numbers of its own that is worth.
    """

    variance: float
    freedom: float

    @classmethod
    def of(cls, fits: Sequence[Fit | None]) -> Usual:
        """From what fits leave: the more alike they are, the more one says of another.

        One that is far from all others, since something is not fitted, counts as less far.
        """
        there = [x for x in fits if x is not None]
        if len(there) < FEWEST:
            return cls(1.0, 0.0)
        half = 0.5 * np.array([x.freedom for x in there])
        logs = np.log([x.scatter for x in there]) - digamma(half) + np.log(half)
        by_chance = polygamma(1, half)
        middle, widest = np.median(logs), 3.0 * np.sqrt(by_chance)  # standard deviations
        logs = np.clip(logs, middle - widest, middle + widest)
        more = float(np.var(logs, ddof=1) - np.mean(by_chance))
        most = 8.0  # half of as many numbers of its own; more, and a tail counts
        if more <= polygamma(1, most):
            own = most
        else:
            own = float(brentq(lambda x: polygamma(1, x) - more, 1e-3, most))
        return cls(float(np.exp(np.mean(logs) + digamma(own) - np.log(own))), 2.0 * own)

    def scatter(self, found: Array | float, freedom: int) -> Array:
        """Scatter to count with where one of `freedom` numbers was found."""
        both = self.freedom * self.variance + freedom * np.asarray(found)
        return np.maximum(both / (self.freedom + freedom), TINY)

    def stds(self, fit: Fit) -> Array:
        """(1 + c,) standard deviations of a fit's coefficients."""
        return np.asarray(fit.alone * np.sqrt(self.scatter(fit.scatter, fit.freedom)))

    def chances(self, fit: Fit) -> Array:
        """(1 + c,) that a coefficient that is zero looks like it."""
        clear = np.abs(fit.found) / np.maximum(self.stds(fit), TINY)
        return np.asarray(2.0 * student.sf(clear, fit.freedom + self.freedom))
