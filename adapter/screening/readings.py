"""How a recording may be told otherwise than its model has it, and whether it is.

Its torques may be in another unit, of another sign or order, without gravity or under another
one; a joint may count the other way, have its zero elsewhere, go by another's name, or be told
against the world, which turns its position, velocity and torque at once. Each such reading gives
other rows, and is judged by the likelihood of their torques (`screening.likelihood`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from adapter.effects.by_joint import smooth_sign
from adapter.model.spatial import Array
from adapter.screening.likelihood import (
    EVIDENCE,
    SMOOTHING_S,
    Explained,
    Rows,
    Telling,
    plausible_nm,
)

NUMBER = 4.0  # what a number costs that a reading takes from the recording: it was one of some ten
UNITS = {
    1000.0: "N mm",
    100.0: "N cm",
    10.1972: "kgf cm or lbf in",
    0.01: "torque of the motors before gears of 1:100",
    0.001: "kN m",
}
NEAR_UNIT = 3.0  # a unit so far from the size that torques have is worth trying
SIZE_ROUNDS, LEAST_FACTOR = 4, 1.5  # of one joint's size; gains and friction explain less
G, ASKEW_RAD = 9.81, np.deg2rad(15.0)  # m/s²; a load bends what torques say of gravity so far


class Reading(NamedTuple):
    """A way in which a recording may be told.

    Attributes:
        kind: "sign", "scale", "order", "gravity", "mounting" or "joint".
        said: what it says, with what mends it.
        rows: as the model would have them.
        numbers: how many it takes from the recording.
    """

    kind: str
    said: str
    rows: Rows
    numbers: int = 0


class TorqueShares(NamedTuple):
    """How much of the model's torque each joint's effort holds, friction and offset left out.

    Attributes:
        share: (n,) recorded units per N m of the model; std: (n,) of it.
        tells: (n,) whether a joint's motion shows its share.
    """

    share: Array
    std: Array
    tells: NDArray[np.bool_]

    @property
    def factor(self) -> Array:
        """(n,) the shares; of a joint that tells nothing that of the middle one."""
        if not self.tells.any():
            return np.ones(len(self.share))
        middle = float(np.median(self.share[self.tells]))
        return np.where(self.tells, self.share, middle)


def torque_shares(rows: Rows, telling: Telling) -> TorqueShares:
    """Of efforts in any unit, joint by joint: friction has an unknown size in it."""
    model = telling.torque(rows)
    m, n = model.shape
    share, std = np.zeros(n), np.full(n, np.inf)
    step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
    for j in np.flatnonzero(telling.alive):
        columns = np.column_stack([np.ones(m), step[:, j], rows.dq[:, j], model[:, j]])
        inverse = np.linalg.pinv(columns.T @ columns)
        if inverse[3, 3] * m * 0.3**2 < 1.0:  # N m rms of its model torque
            x = inverse @ columns.T @ rows.tau[:, j]
            left = np.mean((rows.tau[:, j] - columns @ x) ** 2)
            share[j] = x[3]
            std[j] = np.sqrt(left * inverse[3, 3] * m / min(telling.samples, m))
    return TorqueShares(share, std, 4.0 * std < np.abs(share))  # standard deviations


@dataclass(frozen=True)
class Readings:
    """All readings of a recording.

    Attributes:
        rows: of it; telling: what is likely.
    """

    rows: Rows
    telling: Telling

    def __iter__(self) -> Iterator[Reading]:
        names = self.names
        yield from self._signs()
        yield from self._orders()
        yield from self._gravity()
        for j in range(len(names)):
            yield from self._own(j)
        for i, j in combinations(range(len(names)), 2):
            order = _swapped(len(names), i, j)
            said = f"{names[i]} and {names[j]} are swapped: give each its own name in the recording"
            rows = self.rows.turned(np.eye(len(names))[order])
            yield Reading("joint", said, rows._replace(tau=rows.tau[:, order]))
            if j - i <= 2:  # parallel links
                yield from self._coupled(i, j)
        if not self.telling.unit_known:
            yield from self._units()
            yield from self._sizes()

    @property
    def names(self) -> Sequence[str]:
        """Of the joints."""
        return self.telling.model.tree.joint_names

    @cached_property
    def model(self) -> Array:
        """(m, n) N m."""
        return self.telling.torque(self.rows)

    @cached_property
    def shares(self) -> TorqueShares:
        """Of the model's torque."""
        return torque_shares(self.rows, self.telling)

    def _off(self, tau: Array, joints: Sequence[int]) -> str:
        before, after = (rms((x - self.model)[:, joints]) for x in (self.rows.tau, tau))
        there = " there" if len(joints) < len(self.names) else ""
        unit = self.telling.model.tree.unit("N m", "N", joints[0] if len(joints) == 1 else None)
        so = f"as recorded and by {after:.3g} {unit} so understood"
        return f"the model is off by {before:.3g} {unit}{there} {so}"

    def _signs(self) -> Iterator[Reading]:
        alive = np.flatnonzero(self.telling.alive).tolist()
        against = [j for j in alive if self.shares.tells[j] and self.shares.share[j] < 0.0]
        for joints in filter(None, [alive, against, *([j] for j in alive)]):
            turn = np.where(np.isin(np.arange(len(self.names)), joints), -1.0, 1.0)
            which = "all joints" if joints == alive else ", ".join(self.names[j] for j in joints)
            tau = turn * self.rows.tau
            said = (
                f"the torque of {which} has the wrong sign: {self._off(tau, joints)}; tau is "
                "positive along the joint's axis and holds the arm against gravity: "
                f"{tau_gain(turn)} turns it"
            )
            yield Reading("sign", said, self.rows._replace(tau=tau))

    def _orders(self) -> Iterator[Reading]:
        """The columns in the order that fits best, and two of them swapped."""
        n, alive = len(self.names), np.flatnonzero(self.telling.alive)
        apart = np.abs(self.rows.tau[:, None, :] - self.model[:, :, None])
        apart /= plausible_nm(self.model)[:, None]
        misfit = np.mean(np.minimum(apart, 20.0) ** 2, axis=0)[np.ix_(alive, alive)]
        best = np.arange(n)
        best[alive] = alive[linear_sum_assignment(misfit)[1]]
        for order in [best, *(_swapped(n, i, j) for i, j in combinations(alive.tolist(), 2))]:
            moved = np.flatnonzero(order != np.arange(n)).tolist()
            if not moved:
                continue
            tau = self.rows.tau[:, order]
            own = [(self.names[int(order[j])], self.names[j]) for j in moved]
            pairs = ", ".join(f"{name} holds that of {whose}" for name, whose in own)
            said = (
                "the torques are in another order than the positions, the column of "
                f"{pairs}: {self._off(tau, moved)}; record them in the order of the joint names"
            )
            yield Reading("order", said, self.rows._replace(tau=tau))

    def _gravity(self) -> Iterator[Reading]:
        """Torques without gravity, and with one along another direction of the base."""
        arm, rows, every = self.telling.arm, self.rows, range(len(self.names))
        still = np.zeros_like(rows.q)
        own = arm.torque(rows.q, still, still)
        tau = rows.tau + own
        said = (
            f"the torques hold no gravity: {self._off(tau, every)}, with the model's gravity "
            "torque added; record them with gravity, or --tau gravity-compensated adds the "
            "model's (--gravity 0 0 0 where that of the load was taken off, too)"
        )
        yield Reading("gravity", said, rows._replace(tau=tau))
        axes = np.stack([arm.changed(gravity=g).torque(rows.q, still, still) for g in np.eye(3)], 2)
        weight = self.telling.alive / plausible_nm(self.model)
        columns = (axes * weight[None, :, None]).reshape(-1, 3)
        apart = (rows.tau - self.model + own) * weight
        found = np.asarray(np.linalg.lstsq(columns, apart.ravel(), rcond=None)[0], dtype=float)
        size = float(np.linalg.norm(found))
        if not size or angle(found, arm.gravity) < np.deg2rad(20.0):  # a base that stands askew
            return
        gravity = found * (G / size)
        told = ", ".join(f"{x:.1f}" for x in gravity)
        upright = np.where(np.abs(gravity) > G * np.cos(ASKEW_RAD), G, 0.0)
        mounted = np.copysign(upright, gravity) if upright.any() else gravity
        given = " ".join(f"{x:.4g}" for x in mounted + 0.0)
        tau = rows.tau + own - axes @ gravity
        said = (
            f"gravity acts along [{told}] m/s² of the base and not as in the model: "
            f"{self._off(tau, every)}; say how the arm is mounted, as in --gravity {given}"
        )
        yield Reading("mounting", said, rows._replace(tau=tau), 2)

    def _own(self, j: int) -> Iterator[Reading]:
        """Readings of joint j alone."""
        rows, unit = self.rows, np.eye(len(self.names))[j]
        turn, name = 1.0 - 2.0 * unit, self.names[j]
        said = f"{name} counts the other way round: --turn {name}"
        yield Reading("joint", said, rows.turned(np.diag(turn))._replace(tau=rows.tau * turn))
        for zero in np.deg2rad([-90.0, 90.0, 180.0, -45.0, 45.0]):
            way = "more" if zero > 0.0 else "less"
            said = (
                f"the zero of {name} is elsewhere than the model's: its own angle is "
                f"{abs(np.degrees(zero)):.0f} degrees {way} than what is recorded: "
                f"--zero {name}={-zero:.6g}"
            )
            yield Reading("joint", said, rows._replace(q=rows.q + zero * unit))

    def _coupled(self, i: int, j: int) -> Iterator[Reading]:
        """Joint j told against what carries joint i: its own angle is the sum, or what is left.

        Its drive then sits on that carrier too, and joint i's torque lacks what it holds, or not.
        """
        names = self.names
        for sign, word in ((-1.0, "minus"), (1.0, "plus")):
            turn = np.eye(len(names))
            turn[j, i] = sign
            said = (
                f"{names[j]} is told together with {names[i]} (coupled axes): its angle is what is "
                f"recorded {word} that of {names[i]}; record each joint's own angle and torque"
            )
            own = self.rows.turned(turn)
            yield Reading("joint", said, own)
            yield Reading("joint", said, own._replace(tau=own.tau @ np.linalg.inv(turn)))

    def _units(self) -> Iterator[Reading]:
        """All torques in another unit: a known one, or each joint its own (motor currents)."""
        share, n = self.shares, len(self.names)
        common = float(np.median(np.abs(share.factor)))
        if not share.tells.any() or abs(np.log(common)) < np.log(5.0):  # no model is so wrong
            return
        near = {u: w for u, w in UNITS.items() if abs(np.log(u / common)) < np.log(NEAR_UNIT)}
        for (size, name), sign in [(x, s) for x in near.items() for s in (1.0, -1.0)]:
            factor, turned = np.full(n, sign * size), " and with the opposite sign"
            rows = _divided(self.rows, factor)
            said = (
                f"the torques are {size:.4g} times what the model needs{turned * (sign < 0)} (rms "
                f"{rms(self.rows.tau):.3g} against {rms(self.model):.3g} N m, "
                f"{rms(rows.tau - self.model):.3g} N m off after division): "
                f"{name}? {tau_gain(1.0 / factor)} makes N m at the link of them"
            )
            yield Reading("scale", said, rows)
        telling = np.flatnonzero(share.tells).tolist()
        which = ", ".join(self.names[j] for j in telling)
        way, word = (-1.0, "small") if common < 1.0 else (1.0, "large")
        times = ", ".join(f"{x:.3g}" for x in np.abs(share.share[telling]) ** way)
        silent = [name for j, name in enumerate(self.names) if j not in telling]
        rest = f" ({', '.join(silent)}: not shown)" if silent else ""
        said = (
            f"effort of {which} looks like motor current: {times} times too {word} for any arm of "
            f"this model{rest}; convert them with --tau-gain G1,G2,... (N m per recorded unit, one "
            "per joint or one for all), learn the gains with --tau-gain fit, or give --gear "
            "G1,G2,... where they are torques of the motors; --tau-gain 1 takes them as N m"
        )
        yield Reading("scale", said, _divided(self.rows, share.factor), len(telling))

    def _sizes(self) -> Iterator[Reading]:
        """Torques in a size of its own: of one joint, or in shares of what each joint may."""
        rated, n = self.telling.model.limits.effort, len(self.names)
        for j in np.flatnonzero(self.shares.tells & (self.shares.share > 0.0)).tolist():
            times = np.where(np.arange(n) == j, self.shares.share, 1.0)
            for _ in range(SIZE_ROUNDS):  # a load, which the model lacks, is no size
                times[j] *= self.telling.explained(_divided(self.rows, times)).size[j]
            if abs(np.log(times[j])) > np.log(LEAST_FACTOR):
                said = f"the torque of {self.names[j]} is {times[j]:.3g} times what the model needs"
                rows = _divided(self.rows, times)
                yield Reading("joint", f"{said}: {tau_gain(1.0 / times)}", rows)
        if np.all(np.isfinite(rated) & (rated > 0.0)):
            for whole, word in ((1.0, "shares"), (100.0, "percent"), (1000.0, "per mille")):
                said = f"the torques are {word} of each joint's rated torque"
                rows = _divided(self.rows, whole / rated)
                yield Reading("joint", f"{said}: {tau_gain(rated / whole)}", rows)


def otherwise_told(rows: Rows, telling: Telling) -> tuple[list[Reading], Explained]:
    """How a recording is told, where it is clear on it.

    Returns:
        At most `MOST` readings, one after the other; and how well the model explains the torques
        with them. None where what the hand takes or leaves half way explains more.
    """
    now = telling.explained(rows)
    found: list[Reading] = []
    while len(found) < 3:  # readings in one recording
        far = {loaded: telling.apart(rows, loaded) for loaded in (True, False)}
        # with any load, but for a joint that is told otherwise: a load would bend that, too
        loaded = ((x, x.kind != "joint") for x in Readings(rows, telling))
        nearer = [x for x, any_load in loaded if telling.apart(x.rows, any_load) < far[any_load]]
        explained = [telling.explained(x.rows) for x in nearer]
        costs = [x.cost + NUMBER * y.numbers for x, y in zip(explained, nearer, strict=True)]
        if min(costs, default=np.inf) > now.cost - EVIDENCE:
            break
        held = other_hand(rows, telling)
        if held.cost + NUMBER < min(costs):
            return found, held
        best = int(np.argmin(costs))
        found.append(nearer[best])
        now, rows = explained[best], nearer[best].rows
    return found, now


def other_hand(rows: Rows, telling: Telling) -> Explained:
    """How well the model explains rows where the hand takes or leaves something half way."""
    dates = (np.linspace(0.1, 0.9, 9) * len(rows.q)).astype(int).tolist()
    return min((telling.explained(rows, date) for date in dates), key=lambda x: x.cost)


def _swapped(n: int, i: int, j: int) -> NDArray[np.int64]:
    order = np.arange(n)
    order[[i, j]] = j, i
    return order


def _divided(rows: Rows, factor: Array) -> Rows:
    """Rows whose torques were recorded so many times (n,) too large."""
    more = float(np.log(factor**2).sum())
    return rows._replace(tau=rows.tau / factor, scaled=rows.scaled + more)


def angle(a: Array, b: Array) -> float:
    """Between two vectors, rad."""
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.arccos(np.clip(a @ b / size, -1.0, 1.0))) if size else 0.0


def tau_gain(gain: Array) -> str:
    """The option for gains (n,), in N m per recorded unit."""
    told = gain[:1] if np.ptp(gain) == 0 else gain
    return "--tau-gain=" + ",".join(f"{x:.4g}" for x in told)


def rms(x: Array) -> float:
    """Root of the mean square of all of x."""
    return float(np.sqrt(np.mean(np.square(x))))
