"""How numbers of recordings go over time and over what a manifest tells, and which stand out.

Each recording gives friction and offsets with standard deviations of its own. A line through them
is held against its scatter (Student's t, the scatter being no smaller than those standard
deviations have it), and its chance is multiplied by how many lines were tried (Bonferroni): one
arm in a hundred in which nothing drifts has a false one. The same holds for those that stand out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from adapter.model.spatial import Array

FEWEST = 5  # numbers that a line, or what stands out beside others, takes
CHANCE = 0.01  # of one false alarm among all that is asked of an arm
TOLD_APART = 0.01  # that one column matters beside another one, by chance
COLLINEAR = 1e-8  # share of a column that others leave
MOST_OUT = 0.25  # share of the recordings that may stand out
TINY = 1e-300


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
        value, std: there; expected: from the others.
    """

    number: int
    effect: str
    joint: int
    value: float
    std: float
    expected: float


def courses(
    series: Sequence[Series], columns: Mapping[str, Array]
) -> tuple[list[Drift], list[StandsOut]]:
    """What drifts, the clearest first, and what stands out.

    Args:
        series: all parameters of an arm.
        columns: (m,) what they may follow, NaN where nobody told.
    """
    drifts: list[Drift] = []
    out: list[StandsOut] = []
    tests = len(series) * len(columns)
    for one in series:
        use = np.isfinite(one.values) & (one.std > 0.0)
        found = _drifts(one, columns, use, tests)
        beyond = list(_standing_out(one, [columns[x.follows] for x in found], use, len(series)))
        if beyond:  # a line may have gone through those alone, or they have hidden one
            use[[x.number for x in beyond]] = False
            found = _drifts(one, columns, use, tests)
        drifts += found
        out += beyond
    return sorted(drifts, key=lambda x: (x.chance, -x.span)), out


def _drifts(
    one: Series, columns: Mapping[str, Array], use: NDArray[np.bool_], tests: int
) -> list[Drift]:
    found = []
    for name, x in columns.items():
        on = use & np.isfinite(x)
        fit = _fit(one, [x], on) if on.sum() >= FEWEST else None
        if fit is None or tests * fit.chance[1] >= CHANCE:
            continue
        slope, span = float(fit.found[1]), float(np.ptp(x[on]))
        usual = float(np.average(one.values[on], weights=one.std[on] ** -2.0))
        size = slope, float(fit.std[1]), abs(slope) * span, usual
        found.append(Drift(one.effect, one.joint, name, *size, min(1.0, tests * fit.chance[1])))
    found.sort(key=lambda x: x.chance)
    return list(_told_apart(one, found, columns, use))


def _told_apart(
    one: Series, found: list[Drift], columns: Mapping[str, Array], use: NDArray[np.bool_]
) -> Iterator[Drift]:
    """Without lines that another one explains; those that nothing tells apart become one."""
    gone: set[str] = set()
    for drift in found:
        if drift.follows in gone:
            continue
        rivals = []
        for other in found:
            if other.follows in gone or other is drift:
                continue
            ours, theirs = (columns[x.follows] for x in (drift, other))
            both = _fit(one, [ours, theirs], use & np.isfinite(ours) & np.isfinite(theirs))
            needed = (True, False) if both is None else tuple(both.chance[1:] < TOLD_APART)
            if both is None or not any(needed):
                rivals.append(other.follows)
            elif not needed[0]:
                gone.add(drift.follows)
            if not needed[1]:
                gone.add(other.follows)
        if drift.follows not in gone:
            yield replace(drift, rivals=tuple(rivals))


def _standing_out(
    one: Series, follows: Sequence[Array], use: NDArray[np.bool_], series: int
) -> Iterator[StandsOut]:
    """One after the other, the farthest first, each against all others that are left.

    What a fit without a number foretells of it follows from the fit with it (its leverage).
    """
    use = use & np.all([np.isfinite(x) for x in (one.values, *follows)], axis=0)
    tests = series * int(use.sum())
    for _ in range(int(MOST_OUT * use.sum())):
        fit = _fit(one, follows, use)
        if fit is None or fit.freedom < FEWEST - 2:
            return
        away, rest = fit.left / (1.0 - fit.leverage), 1.0 - fit.leverage
        others = (np.sum(fit.left**2) - fit.left * away) / (fit.freedom - 1)
        clear = np.abs(away) * np.sqrt(rest / np.maximum(1.0, others))
        worst = int(np.argmax(clear))
        if tests * 2.0 * float(student.sf(clear[worst], fit.freedom - 1)) >= CHANCE:
            return
        k = int(np.flatnonzero(use)[worst])
        value, std = float(one.values[k]), float(one.std[k])
        use[k] = False
        yield StandsOut(k, one.effect, one.joint, value, std, value - std * float(away[worst]))


class Fit(NamedTuple):
    """A weighted fit of a constant and columns.

    Attributes:
        found, std: (1 + c,) coefficients and standard deviations.
        covariance: of these, (1 + c, 1 + c).
        chance: (1 + c,) that a coefficient that is zero looks like it.
        left, leverage: of the numbers in use: what the fit leaves, in standard deviations of its
            own, and how far the fit follows it.
        freedom: numbers more than coefficients.
    """

    found: Array
    std: Array
    chance: Array
    left: Array
    leverage: Array
    freedom: int


def _fit(one: Series, follows: Sequence[Array], use: NDArray[np.bool_]) -> Fit | None:
    """None where there are too few numbers, or columns that go together."""
    freedom = int(use.sum()) - 1 - len(follows)
    if freedom < 2:
        return None
    middle = np.array([np.mean(x[use]) for x in follows])
    size = np.array([np.std(x[use]) or 1.0 for x in follows])
    scaled = [(x[use] - m) / s for x, m, s in zip(follows, middle, size, strict=True)]
    rows = np.column_stack([np.ones(int(use.sum())), *scaled]) / one.std[use, None]
    sides, values, turn = np.linalg.svd(rows, full_matrices=False)
    if values[-1] <= COLLINEAR * values[0]:
        return None
    target = one.values[use] / one.std[use]
    left = target - sides @ (sides.T @ target)
    scatter = max(1.0, float(left @ left) / freedom)
    back = np.diag(np.r_[1.0, 1.0 / size])  # to the columns' own units
    back[0, 1:] = -middle / size
    back = back @ turn.T / values
    found, std = back @ (sides.T @ target), np.sqrt(scatter * np.sum(back**2, axis=1))
    chance = 2.0 * student.sf(np.abs(found) / np.maximum(std, TINY), freedom)
    return Fit(found, std, chance, left, np.sum(sides**2, axis=1), freedom)
