"""How well a model is known, all its numbers together, and draws from that.

What was learned of the links' θ and of the effects beside it is one Gaussian. A drawn body must be
able to exist: where what data show (the Gaussian) would have it otherwise, what no data show gives
way, and only then the draw is taken again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.errors import ModelError
from adapter.model.inertia import (
    BODY_SIZE,
    CONSISTENCY_TOLERANCE,
    LIGHT_KG,
    min_eigenvalue,
    pseudo_inertia,
)
from adapter.model.spatial import Array

DIGITS = 8  # of a root in a file: the best known combinations are some 1e-5 of the single numbers
REDRAWN, HALVED = 20, 12  # times, of a draw whose bodies cannot exist
FAR = 1e3  # times rounding: as near as a drawn body comes to one that cannot exist
Label = tuple[str, int, str]  # effect, joint (from 1; 0 without one) and key of one of its numbers


@dataclass(frozen=True, eq=False)
class Posterior:
    """What data and priors say together of the numbers that were learned.

    What data did not show has no width: it is the documentation's, in draws too.

    Attributes:
        effects: of the e numbers beside θ; least: (e,) that each can be at least, -inf without end.
        root: (10 n + e, r) lower triangular; root rootᵀ is the covariance of the links' θ (kg,
            kg m, kg m²), link by link, and of the effects' numbers, in their units.
        room: (n, 10) θ that no data tell from zero, and by which the bodies lie farther inside of
            what can exist.
        lam_root: (n, 6, 6) lower triangular, of each frame's turn and shift (rad, m), in the axes
            of its parent.
    """

    effects: tuple[Label, ...]
    least: Array
    root: Array
    room: Array
    lam_root: Array

    def check(self, n: int) -> None:
        """Raises ModelError where its shapes are not those of n joints."""
        e = len(self.effects)
        have = np.shape(self.least), np.shape(self.root)[:1], self.room.shape, self.lam_root.shape
        if have != ((e,), (10 * n + e,), (n, 10), (n, 6, 6)):
            raise ModelError(f"a posterior of {n} joints and {e} numbers of effects has not {have}")


def root_of(covariance: Array, rank: int) -> Array:
    """Lower triangular root (p, rank) of a covariance (p, p), rounded as files have it."""
    std = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    unit = np.where(std > 0.0, std, 1.0)
    values, ways = np.linalg.eigh(covariance / np.outer(unit, unit))
    best = slice(len(unit) - rank, None)
    full = unit[:, None] * ways[:, best] * np.sqrt(np.maximum(values[best], 0.0))
    triangle = np.linalg.qr(full.T)[1].T
    rounded = [
        float(f"{x:.{DIGITS}g}") for x in (triangle * np.sign(np.diagonal(triangle))).ravel()
    ]
    return np.tril(np.reshape(rounded, triangle.shape))


def room_of(theta: Array, basis: Array) -> Array:
    """By how much θ lacks to the middle of possible bodies that data cannot tell from it.

    The middle has the largest product of the pseudo-inertias' determinants, held near θ by the
    squares of what is added, in bodies of the same mass, 10 cm across.

    Args:
        theta: (n, 10), possible; basis: (10 n, rank) orthonormal, what data told.
    """
    size = np.maximum(theta[:, :1], LIGHT_KG) * BODY_SIZE
    rows = np.linalg.qr(basis * size.reshape(-1, 1))[0]
    hidden = np.linalg.svd(rows, full_matrices=True)[0][:, rows.shape[1] :].T
    ways = hidden.reshape(-1, *theta.shape) * size  # (h, n, 10) of a unit each
    slopes, at = pseudo_inertia(ways), np.zeros(len(ways))

    def value(y: Array) -> float:
        bodies = theta + np.tensordot(y, ways, 1)
        if not (min_eigenvalue(bodies) > 0.0).all():
            return -np.inf
        return float(np.linalg.slogdet(pseudo_inertia(bodies))[1].sum() - 0.5 * y @ y)

    for _ in range(30):  # steps to the middle of what is possible; it takes a dozen
        inverse = np.linalg.inv(pseudo_inertia(theta + np.tensordot(at, ways, 1)))
        part = inverse @ slopes  # (h, n, 4, 4)
        gradient = np.trace(part, axis1=2, axis2=3).sum(axis=1) - at
        curved = np.einsum("injk,mnkj->im", part, part) + np.eye(len(at))
        step = np.linalg.solve(curved, gradient)
        share, before = 1.0, value(at)
        while share > 1e-9 and not value(at + share * step) > before:
            share *= 0.5
        at = at + share * step
        if share * np.abs(step).max(initial=0.0) < 1e-6:
            break
    return np.asarray(np.tensordot(at, ways, 1))


class Number(NamedTuple):
    """A number of an effect that has a standard deviation: whose, its place in a table, itself."""

    entry: int
    label: Label
    at: int | None
    value: float
    std: float


def doubted(effects: Sequence[Mapping[str, Any]]) -> list[Number]:
    """Numbers of a model's effects that have a standard deviation, joint by joint.

    Whole inertias (of a load, of a link) have none here: a change of single ones is no body's.
    """
    found = []
    for k, entry in enumerate(effects):
        joints = [int(j) for j in entry.get("joints") or (0,)]
        for key, std in (entry.get("std") or {}).items():
            value, one = entry["parameters"].get(key), not np.ndim(std)
            if np.shape(value) not in ((), (len(joints),)):
                continue
            table = np.ndim(value) == 1
            values, stds = (value if table else [value]), ([std] * len(joints) if one else std)
            for i, (x, s) in enumerate(zip(values, stds, strict=False)):
                if s is not None and np.isfinite(s):
                    at = i if table else None
                    found.append(Number(k, (entry["effect"], joints[i], key), at, x, float(s)))
    return found


def with_numbers(
    effects: Sequence[Mapping[str, Any]], numbers: Sequence[Number], values: Array
) -> tuple[dict[str, Any], ...]:
    """A model's effects with other values of some numbers."""
    out = [{**entry, "parameters": dict(entry["parameters"])} for entry in effects]
    for number, value in zip(numbers, values.tolist(), strict=True):
        own, key = out[number.entry]["parameters"], number.label[2]
        if number.at is None:
            own[key] = value
        else:
            own[key] = [*own[key][: number.at], value, *own[key][number.at + 1 :]]
    return tuple(out)


class Doubt(NamedTuple):
    """A Gaussian over numbers of which the first are bodies, inside of what is possible.

    Attributes:
        mean: (p,); root: (p, k), root rootᵀ is its covariance.
        room: (bodies, 10) that may be added to the bodies, ten numbers each, for them to exist.
        low, high: (p - 10 bodies,) between which each other number can be.
    """

    mean: Array
    root: Array
    room: Array
    low: Array
    high: Array

    @classmethod
    def over(
        cls, theta: Array, std: Array, numbers: Sequence[Number], posterior: Posterior | None
    ) -> Doubt:
        """Over θ (bodies, 10) and the effects' numbers.

        Of what the posterior does not tell each number has its own standard deviation alone, and
        keeps its sign; without one (NaN) it stays.
        """
        value, own_std = (np.array([getattr(x, k) for x in numbers]) for k in ("value", "std"))
        low, high = np.where(value > 0.0, 0.0, -np.inf), np.where(value < 0.0, 0.0, np.inf)
        mean, room = np.concatenate([theta.ravel(), value]), np.zeros_like(theta)
        root = np.diag(np.concatenate([np.nan_to_num(std).ravel(), own_std]))
        if posterior is not None:
            told = posterior.room.size  # θ of the links, after that of a base which floats
            first = {x.label: k for k, x in reversed([*enumerate(numbers)])}
            # of a number that a search refined later the rest has its own deviation
            rows = [k for k, label in enumerate(posterior.effects) if label in first]
            own = [first[posterior.effects[k]] for k in rows]
            at = [*range(theta.size - told, theta.size), *(theta.size + k for k in own)]
            together = np.zeros((len(mean), posterior.root.shape[1]))
            together[at] = posterior.root[[*range(told), *(told + k for k in rows)]]
            root[at] = 0.0
            root = np.hstack([root, together])
            low[own], high[own] = posterior.least[np.array(rows, dtype=int)], np.inf
            room[len(theta) - len(posterior.room) :] = posterior.room
        return cls(mean, root[:, root.any(axis=0)], room, low, high)

    def draws(self, count: int, rng: np.random.Generator) -> Array:
        """(count, p) inside of what is possible. A body at the edge of it stays as it is."""
        size, root = self.room.size, self.root.copy()
        bodies = self.mean[:size].reshape(-1, 10)
        own, rounding = min_eigenvalue(bodies), CONSISTENCY_TOLERANCE * np.abs(bodies).max(axis=1)
        inside = own > 2.0 * rounding
        root[:size][np.repeat(~inside, 10)] = 0.0
        # farther from impossible than rounding goes; of a body that is nearer, half of what it has
        margin = np.where(inside, np.minimum(0.5 * own, FAR * rounding), -np.inf)
        room = np.concatenate([(self.room * inside[:, None]).ravel(), np.zeros(len(self.low))])

        out, left = np.tile(self.mean, (count, 1)), np.arange(count)
        for turn in range(REDRAWN + 1):
            x = self.mean + rng.standard_normal((len(left), root.shape[1])) @ root.T
            way = room if turn < REDRAWN else self.mean - x  # at last back as far as they exist
            low, high = np.zeros(len(x)), np.where(_exist(x, margin), 0.0, 1.0)
            for _ in range(HALVED):  # the least share of the way after which they exist, if at all
                middle = 0.5 * (low + high)
                good = _exist(x + middle[:, None] * way, margin)
                low, high = np.where(good, low, middle), np.where(good, middle, high)
            x += high[:, None] * way
            good = _exist(x, margin)
            out[left[good]], left = x[good], left[~good]
        others = out[:, size:]  # beyond a bound they are as far on this side of it
        others[:] = np.where(others < self.low, 2.0 * self.low - others, others)
        others[:] = np.where(others > self.high, 2.0 * self.high - others, others)
        return out


def _exist(x: Array, margin: Array) -> NDArray[np.bool_]:
    """(m,) whether bodies, the first numbers of rows x (m, p), are inside by a margin (bodies,)."""
    bodies = x[:, : 10 * len(margin)].reshape(len(x), len(margin), 10)
    return np.asarray((min_eigenvalue(bodies) > margin).all(axis=1))
