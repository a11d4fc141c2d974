"""Whether a joint as a whole is told otherwise than the model has it.

A joint that counts the other way, whose zero is elsewhere, that goes by another's name, or that is
told against the world turns its position, velocity and torque at once: no reading of the torques
alone mends that. Each such reading moves the model's own torques, and is judged by the likelihood
of what it leaves: inertias, a payload, friction, offsets and gains have their priors, and each
joint's noise is unknown, so that an arm that is not quite its model needs more evidence than one
that is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.by_joint import smooth_sign
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.torque_units import (
    FLOOR_NM,
    FLOOR_SHARE,
    FRICTION,
    SEEN_NM,
    SMOOTHING_S,
    inertial_std,
    tau_gain,
)

SENSOR_NM, SENSOR_SHARE, SENSOR_WEIGHT = 0.03, 0.01, 4.0  # prior of a joint's noise; in samples
CORRELATED_S, MOST_SAMPLES = 0.4, 50.0  # an arm's misfit keeps its sign so long; and no more count
HELD = 3.0  # standard deviations of a gain at most: what is further off is no gain
ROUNDS = 6  # of noise after fit; it settles in three
EVIDENCE = 25.0  # twice the log-likelihood that a reading must gain: odds of 1 to 270 000
MOST = 3  # readings in one recording
ROWS = 100  # instants that are judged
ZEROS = np.deg2rad([-90.0, 90.0, 180.0, -45.0, 45.0])
BEYOND_RAD, BEYOND = 0.2, 100.0  # over a limit; what a recording all beyond it costs
SIZE_ROUNDS = 4  # of one joint's size beside all else
LEAST_FACTOR = 1.5  # of one joint's torque; gains and friction explain less
NEAR = 2  # joints up to which an axis may be told against another (parallel links)
# Of the variance of torques: middle joint and best one. Real arms: 0.9 and 0.97 at least.
EXPLAINED, BEST_EXPLAINED = 0.5, 0.85
# Of torques that come late: steps in which it is sought and how many, ms; less than `LATE_S` is
# within the timing of samples.
LATE_STEPS, LATEST_MS, LATE_S = ((20, 10), (4, 4), (1, 3)), 219, 0.004


class Rows(NamedTuple):
    """Instants of a recording: q, dq, ddq, tau (m, n); and twice the log of tau's scale.

    A reading that divides torques makes its misfit smaller by that alone, which counts for nothing.
    """

    q: Array
    dq: Array
    ddq: Array
    tau: Array
    scaled: float = 0.0


class Explained(NamedTuple):
    """How well rows are explained.

    Attributes:
        cost: twice the negative log-likelihood.
        share, size: of each joint's torque the share (n,) of its variance that is explained, and
            its size (n,) as a multiple of the model's.
        x: (10 n + 4 n,) corrections, in standard deviations.
    """

    cost: float
    share: Array
    size: Array
    x: Array


@dataclass(frozen=True)
class Telling:
    """What is likely of the recordings of an arm.

    Attributes:
        model: of the arm; arm: its rigid body.
        alive: (n,) joints whose torque is measured.
        span_s: of the rows; so many samples of a misfit with memory are independent.
        unit_known: somebody says that torques are in N m.
    """

    model: SelfModel
    arm: RigidArm
    alive: NDArray[np.bool_]
    span_s: float
    unit_known: bool = False

    @property
    def samples(self) -> float:
        """Independent samples of a joint."""
        return min(MOST_SAMPLES, self.span_s / CORRELATED_S)

    def explained(self, rows: Rows) -> Explained:
        """How well the model explains rows, after corrections of a plausible size."""
        return self.explaining(rows)(rows.tau)

    def explaining(self, rows: Rows) -> Callable[[Array], Explained]:
        """The same of any torques (m, n) of these instants."""
        columns, model = self._columns(rows)
        m, beyond = len(model), self._beyond(rows.q)
        usual = np.sqrt(np.mean(model**2, axis=0))
        floor = SENSOR_NM + SENSOR_SHARE * usual
        squares = np.einsum("mjk,mjl->jkl", columns, columns, optimize=True)

        def of(tau: Array) -> Explained:
            apart, sigma = tau - model, FLOOR_NM + FLOOR_SHARE * usual
            products = np.einsum("mjk,mj->jk", columns, apart)
            for _ in range(ROUNDS):
                weight = np.where(self.alive, self.samples / m / sigma**2, 0.0)
                normal = np.eye(columns.shape[2]) + np.tensordot(weight, squares, 1)
                x = np.linalg.solve(normal, weight @ products)
                x[-len(usual) :] = np.clip(x[-len(usual) :], -HELD, HELD)
                left = np.mean((apart - columns @ x) ** 2, axis=0)
                total = self.samples + SENSOR_WEIGHT
                sigma = np.sqrt((self.samples * left + SENSOR_WEIGHT * floor**2) / total)
            noise = self.samples * np.log(sigma**2) + SENSOR_WEIGHT * (floor / sigma) ** 2
            cost = float(noise[self.alive].sum() + x @ x) + self.samples * rows.scaled
            share = 1.0 - left / np.maximum(tau.var(axis=0), floor**2)
            size = 1.0 + FRICTION[-1] * x[-len(share) :]
            return Explained(cost + beyond, share, size, x)

        return of

    def torque(self, rows: Rows) -> Array:
        """(m, n) N m of the model without corrections."""
        return np.asarray(self.arm.torque(rows.q, rows.dq, rows.ddq))

    def corrected(self, x: Array, rows: Rows) -> Array:
        """(m, n) N m of the model with corrections x, see `Explained`; `rows.tau` is not used."""
        n, model = self.arm.n, self.torque(rows)
        own = x[10 * n :].reshape(len(FRICTION), n) * np.array(FRICTION)[:, None]
        arm = self.arm.changed(self.arm.theta + inertial_std(self.arm) * x[: 10 * n].reshape(n, 10))
        step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
        friction = own[0] + own[1] * step + own[2] * rows.dq + own[3] * model
        return np.asarray(arm.torque(rows.q, rows.dq, rows.ddq) + friction)

    def apart(self, rows: Rows) -> float:
        """How far the model without corrections is from rows; a true reading brings it nearer."""
        apart = np.mean((rows.tau - self.torque(rows)) ** 2, axis=0)[self.alive]
        return float(np.log(apart + SENSOR_NM**2).sum()) + rows.scaled

    def _columns(self, rows: Rows) -> tuple[Array, Array]:
        """(m, n, c) torque per standard deviation of each correction; (m, n) of the model."""
        regressor = self.arm.regressor(rows.q, rows.dq, rows.ddq)
        model = regressor @ self.arm.theta.ravel()
        m, n = model.shape
        step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
        joint = np.zeros((m, n, len(FRICTION), n))
        for k, column in enumerate((np.ones_like(model), step, rows.dq, model)):
            joint[:, range(n), k, range(n)] = FRICTION[k] * column
        inertial = regressor * inertial_std(self.arm).ravel()
        return np.concatenate([inertial, joint.reshape(m, n, -1)], axis=2), model

    def _beyond(self, q: Array) -> float:
        """What positions (m, n) outside the model's limits cost."""
        low, high = self.model.limits.lower, self.model.limits.upper
        over = (np.maximum(q - high, low - q) > BEYOND_RAD) & (high > low)
        return BEYOND * float(over.mean(axis=0).sum())


def _own(rows: Rows, names: Sequence[str], j: int) -> Iterator[tuple[str, Rows]]:
    """Readings of joint j alone."""
    (q, dq, ddq, tau, scaled), unit = rows, np.eye(len(names))[j]
    turn = 1.0 - 2.0 * unit
    yield (
        f"{names[j]} counts the other way round: --turn {names[j]}",
        Rows(q * turn, dq * turn, ddq * turn, tau * turn, scaled),
    )
    for zero in ZEROS:
        way = "more" if zero > 0.0 else "less"
        yield (
            f"the zero of {names[j]} is elsewhere than the model's: its own angle is "
            f"{abs(np.degrees(zero)):.0f} degrees {way} than what is recorded: "
            f"--zero {names[j]}={-zero:.6g}",
            Rows(q + zero * unit, dq, ddq, tau, scaled),
        )


def _coupled(rows: Rows, names: Sequence[str], i: int, j: int) -> Iterator[tuple[str, Rows]]:
    """Joint j told against what carries joint i: its own angle is the sum of both, or what is left.

    Its drive then sits on that carrier too, and joint i's torque lacks what it holds, or does not.
    """
    q, dq, ddq, tau, scaled = rows
    for sign, word in ((-1.0, "minus"), (1.0, "plus")):
        turn = np.eye(len(names))
        turn[j, i] = sign
        said = (
            f"{names[j]} is told together with {names[i]} (coupled axes): its angle is what is "
            f"recorded {word} that of {names[i]}; record each joint's own angle and torque"
        )
        own = Rows(q @ turn.T, dq @ turn.T, ddq @ turn.T, tau, scaled)
        yield said, own
        yield said, own._replace(tau=tau @ np.linalg.inv(turn))


def _sizes(rows: Rows, telling: Telling) -> Iterator[tuple[str, Rows]]:
    """Torques in a size of its own: of one joint, or in shares of what each joint may."""
    names, rated = telling.model.tree.joint_names, telling.model.limits.effort
    model = telling.torque(rows)
    for j, name in enumerate(names):
        size = float(model[:, j] @ model[:, j])
        factor = float(rows.tau[:, j] @ model[:, j]) / size if size else 0.0
        seen = telling.alive[j] and factor > 0.0 and size > len(model) * SEEN_NM**2
        if seen and abs(np.log(factor)) > np.log(LEAST_FACTOR):
            times = np.ones(len(names))
            times[j] = factor
            for _ in range(SIZE_ROUNDS):  # a load, which the model lacks, is no size
                times[j] *= telling.explained(_divided(rows, times)).size[j]
            if abs(np.log(times[j])) > np.log(LEAST_FACTOR):
                said = f"the torque of {name} is {times[j]:.3g} times what the model needs"
                yield f"{said}: {tau_gain(1.0 / times)}", _divided(rows, times)
    if np.all(np.isfinite(rated) & (rated > 0.0)):
        for whole, word in ((1.0, "shares"), (100.0, "percent"), (1000.0, "per mille")):
            said = f"the torques are {word} of each joint's rated torque"
            yield f"{said}: {tau_gain(rated / whole)}", _divided(rows, whole / rated)


def _divided(rows: Rows, factor: Array) -> Rows:
    """Rows whose torques were recorded so many times (n,) too large."""
    more = float(np.log(factor**2).sum())
    return rows._replace(tau=rows.tau / factor, scaled=rows.scaled + more)


def lateness_s(signals: Sequence[Array], telling: Telling) -> float:
    """How much later than the motion torques come, s, where that is clear; 0 up to `LATE_S`.

    Args:
        signals: q, dq, ddq, tau (m, n), 1 ms apart.
    """
    q, dq, ddq, tau = signals
    if len(q) < 2 * LATEST_MS + ROWS:
        return 0.0
    at = np.linspace(LATEST_MS, len(q) - 1 - LATEST_MS, ROWS).astype(int)

    of = telling.explaining(Rows(q[at], dq[at], ddq[at], tau[at]))

    def cost(late_ms: int) -> float:
        return of(tau[at + late_ms]).cost

    late_ms = 0
    for step, reach in LATE_STEPS:
        late_ms = min((late_ms + step * k for k in range(-reach, reach + 1)), key=cost)
    clear = cost(late_ms) < cost(0) - EVIDENCE
    return 1e-3 * late_ms if clear and abs(late_ms) > 1e3 * LATE_S else 0.0


def joint_readings(rows: Rows, telling: Telling) -> Iterator[tuple[str, Rows]]:
    """Sentences on how the joints may be told, and the rows if it is so."""
    names, (q, dq, ddq, tau, _) = telling.model.tree.joint_names, rows
    for j in range(len(names)):
        yield from _own(rows, names, j)
    for i, j in combinations(range(len(names)), 2):
        order = [j if k == i else i if k == j else k for k in range(len(names))]
        said = f"{names[i]} and {names[j]} are swapped: give each its own name in the recording"
        yield said, Rows(q[:, order], dq[:, order], ddq[:, order], tau[:, order], rows.scaled)
        if j - i <= NEAR:
            yield from _coupled(rows, names, i, j)
    if not telling.unit_known:
        yield from _sizes(rows, telling)


def otherwise_told(rows: Rows, telling: Telling) -> tuple[list[str], Explained]:
    """How the joints are told, where the recording is clear on it.

    Returns:
        A sentence for each reading, at most `MOST`; and how well the model explains the torques
        with them.
    """
    now = telling.explained(rows)
    said: list[str] = []
    while len(said) < MOST:
        far = telling.apart(rows)
        nearer = [x for x in joint_readings(rows, telling) if telling.apart(x[1]) < far]
        trials = [(telling.explained(x), word, x) for word, x in nearer]
        best, word, changed = min(trials, key=lambda trial: trial[0].cost, default=(now, "", rows))
        if best.cost > now.cost - EVIDENCE:
            break
        said.append(word)
        now, rows = best, changed
    return said, now


def explains_nothing(share: Array) -> bool:
    """Whether so small shares of the torques of moving joints are those of no arm of the model."""
    return bool(share.size and np.median(share) < EXPLAINED and share.max() < BEST_EXPLAINED)
