"""How likely a recording's torques are, of an arm that may differ from its model as arms do.

Inertias, a payload, friction, offsets and gains have their priors, and each joint's noise is
unknown, so that an arm that is not quite its model needs more evidence for anything else than one
that is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.bristle_friction import bending
from adapter.effects.by_joint import SMOOTHING_DQ, WAYS_RAD, smooth_sign
from adapter.effects.torque import ModelTorque
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm

FLOOR_NM, FLOOR_SHARE = 0.15, 0.1  # where the search for the noise begins: N m, share of the torque
INERTIA_SHARE, RADIUS_M = 0.4, 0.1  # plausible error of masses; of where they sit
LOAD_STD = np.repeat((3.0, 0.3, 0.05), (1, 3, 6))  # kg, kg m, kg m2
FRICTION = (1.0, 4.0, 4.0, 0.1)  # std of offset, Coulomb, viscous (N m, N m, N m s/rad), gain
SMOOTHING_S = 0.018  # of a step by the 10 Hz low-pass that motion and torque went through
SENSOR_NM, SENSOR_SHARE, SENSOR_WEIGHT = 0.03, 0.01, 4.0  # prior of a joint's noise; in samples
CORRELATED_S, MOST_SAMPLES = 0.15, 50.0  # a misfit keeps its sign so long; and no more count
HELD = 3.0  # standard deviations of a gain at most: what is further off is no gain
REST = 0.3  # root of the weight of a row at rest: a second of them is about one independent one
EVIDENCE = 40.0  # twice the log-likelihood that a reading must gain: odds of 1 to 500 million
ROWS = 100  # instants that are judged
BEYOND_RAD, BEYOND = 0.2, 100.0  # over a limit; what a recording all beyond it costs
# Of the variance of torques: middle joint and best one. Real arms: 0.9 and 0.97 at least.
EXPLAINED, BEST_EXPLAINED = 0.5, 0.85
# Of torques that come late: steps in which it is sought and how many, ms; less than `LATE_S` is
# within the timing of samples.
TURNS = 5  # times as many rows, among which are some of each way back
LATE_STEPS, LATEST_MS, LATE_S = ((20, 10), (4, 4), (1, 3)), 219, 0.004


class Rows(NamedTuple):
    """Instants of a recording: q, dq, ddq, tau (m, n); and twice the log of tau's scale.

    `slides` (m, n), -1 to 1, is which way friction acts; the way that joints move where None.

    A reading that divides torques makes its misfit smaller by that alone, which counts for nothing.
    """

    q: Array
    dq: Array
    ddq: Array
    tau: Array
    scaled: float = 0.0
    slides: Array | None = None

    def turned(self, turn: Array) -> Rows:
        """Of joints whose angles are `turn` (n, n) times these; torques as they are."""
        q, dq, ddq = (x @ turn.T for x in (self.q, self.dq, self.ddq))
        slides = None
        if self.slides is not None:
            several = np.count_nonzero(turn, axis=1) > 1  # nobody knows how far these are wound
            slides = np.where(several, smooth_sign(dq, ddq, SMOOTHING_S), self.slides @ turn.T)
        return self._replace(q=q, dq=dq, ddq=ddq, slides=slides)


class Explained(NamedTuple):
    """How well rows are explained.

    Attributes:
        cost: twice the negative log-likelihood.
        share, size: of each joint's torque the share (n,) of its variance that is explained, and
            its size (n,) as a multiple of the model's.
        x: (10 n + 4 n,) corrections, in standard deviations, and what else was asked for.
    """

    cost: float
    share: Array
    size: Array
    x: Array


@dataclass(frozen=True)
class Telling:
    """What is likely of the recordings of an arm.

    Attributes:
        model: of the arm.
        alive: (n,) joints whose torque is measured.
        span_s: of the rows; so many samples of a misfit with memory are independent.
        unit_known: somebody says that torques are in N m.
    """

    model: SelfModel
    alive: NDArray[np.bool_]
    span_s: float
    unit_known: bool = False

    @cached_property
    def arm(self) -> RigidArm:
        """Rigid body of the model."""
        return RigidArm.of(self.model)

    @cached_property
    def _documented(self) -> ModelTorque:
        return ModelTorque(self.model)

    @property
    def samples(self) -> float:
        """Independent samples of a joint."""
        return min(MOST_SAMPLES, self.span_s / CORRELATED_S)

    def rubbing(self, rows: Rows, q: Array, at: slice | NDArray[np.int64]) -> Rows:
        """Rows at instants of q (m, n), 1 ms apart, with the friction that explains them best.

        Of each joint it turns round at once, or winds up over a way and holds through rests.
        """
        wound = [np.column_stack([bending(x, way)[at] for x in q.T]) for way in WAYS_RAD]
        every = np.array([smooth_sign(rows.dq, rows.ddq, SMOOTHING_S), *wound])
        best = np.argmax([self.explained(rows._replace(slides=x)).share for x in every], axis=0)
        return rows._replace(slides=every[best, :, range(len(best))].T)

    def explained(self, rows: Rows, changed: int | None = None) -> Explained:
        """How well the model explains rows, after corrections of a plausible size.

        Args:
            changed: the row from which on the hand holds something else; None for never.
        """
        return self.explaining(rows, changed)(rows.tau)

    def askew(self, rows: Rows) -> tuple[Explained, Array]:
        """How well rows are explained on a base that stands askew, and gravity (3,) in its axes."""
        arm, still = self.arm, np.zeros_like(rows.q)
        size = float(np.linalg.norm(arm.gravity))
        aside = size * np.deg2rad(5.0) * np.linalg.svd(arm.gravity[None])[2][1:]  # of a base
        bodies = arm.theta
        for _ in range(2):  # what the hand holds is askew as well
            tilts = [arm.changed(bodies, x).torque(rows.q, still, still) for x in aside]
            found = self.explaining(rows, more=np.stack(tilts, axis=2))(rows.tau)
            bodies = arm.theta + inertial_std(arm) * found.x[: bodies.size].reshape(bodies.shape)
        gravity = arm.gravity + found.x[-2:] @ aside
        return found, gravity * (size / np.linalg.norm(gravity))

    def explaining(
        self, rows: Rows, changed: int | None = None, more: Array | None = None
    ) -> Callable[[Array], Explained]:
        """The same of any torques (m, n) of these instants, by columns `more` (m, n, k) too."""
        columns, model = self._columns(rows, changed)
        if more is not None:
            columns = np.concatenate([columns, more], axis=2)
        (m, n), limits = model.shape, self.model.limits
        over = np.maximum(rows.q - limits.upper, limits.lower - rows.q) > BEYOND_RAD
        beyond = BEYOND * float((over & (limits.upper > limits.lower)).mean(axis=0).sum())
        counts = np.where(np.abs(rows.dq) < SMOOTHING_DQ, REST, 1.0)  # as roots of weights
        counts /= np.sqrt(np.mean(np.square(counts), axis=0))
        columns *= counts[:, :, None]
        floor = sensor_nm(np.mean(model**2, axis=0))
        squares = np.einsum("mjk,mjl->jkl", columns, columns, optimize=True)
        gains = slice(13 * n, 14 * n)

        def of(tau: Array) -> Explained:
            apart, sigma = counts * (tau - model), plausible_nm(model)
            products = np.einsum("mjk,mj->jk", columns, apart)
            for _ in range(6):  # of noise after fit; it settles in three
                weight = np.where(self.alive, self.samples / m / sigma**2, 0.0)
                normal = np.eye(columns.shape[2]) + np.tensordot(weight, squares, 1)
                x = np.linalg.solve(normal, weight @ products)
                x[gains] = np.clip(x[gains], -HELD, HELD)
                left = np.mean((apart - columns @ x) ** 2, axis=0)
                sigma = noise_nm(left, self.samples, floor)
            noise = self.samples * np.log(sigma**2) + SENSOR_WEIGHT * (floor / sigma) ** 2
            cost = float(noise[self.alive].sum() + x @ x) + self.samples * rows.scaled
            # samples that it takes to fit so much explain nothing
            used = weight * np.tensordot(squares, np.linalg.inv(normal), 2)
            honest = left / np.maximum(1.0 - used / self.samples, 1.0 / self.samples)
            share = 1.0 - honest / np.maximum(tau.var(axis=0), floor**2)
            size = 1.0 + FRICTION[-1] * x[gains]
            return Explained(cost + beyond, share, size, x)

        return of

    def torque(self, rows: Rows) -> Array:
        """(m, n) N m of the model without corrections."""
        return self._documented(rows.q, rows.dq, rows.ddq)

    def corrected(self, x: Array, rows: Rows) -> Array:
        """(m, n) N m of the model with corrections x, see `Explained`; `rows.tau` is not used."""
        n, model = self.arm.n, self.torque(rows)
        own = x[10 * n : 14 * n].reshape(len(FRICTION), n) * np.array(FRICTION)[:, None]
        bodies = self.arm.changed(inertial_std(self.arm) * x[: 10 * n].reshape(n, 10))
        step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
        friction = own[0] + own[1] * step + own[2] * rows.dq + own[3] * model
        return np.asarray(model + bodies.torque(rows.q, rows.dq, rows.ddq) + friction)

    def apart(self, rows: Rows, loaded: bool) -> float:
        """How far the model, with any load or bare, is from rows; a true reading is nearer."""
        model = self.torque(rows)
        more = rows.tau - model
        if loaded:
            weight = np.sqrt(self.samples / len(model)) * self.alive / plausible_nm(model)
            load = self.arm.regressor(rows.q, rows.dq, rows.ddq)[:, :, -10:] * LOAD_STD
            flat = (load * weight[:, None]).reshape(-1, 10)
            x = np.linalg.solve(flat.T @ flat + np.eye(10), flat.T @ (more * weight).ravel())
            more = more - load @ x
        left = np.mean(more**2, axis=0)[self.alive]
        return float(np.log(left + SENSOR_NM**2).sum()) + rows.scaled

    def _columns(self, rows: Rows, changed: int | None) -> tuple[Array, Array]:
        """(m, n, c) torque per standard deviation of each correction; (m, n) of the model."""
        regressor = self.arm.regressor(rows.q, rows.dq, rows.ddq)
        model = self.torque(rows)
        step = rows.slides
        if step is None:
            step = smooth_sign(rows.dq, rows.ddq, SMOOTHING_S)
        own = (np.ones_like(model), step, rows.dq, model)
        joint = by_joint([std * column for std, column in zip(FRICTION, own, strict=True)])
        parts = [regressor * inertial_std(self.arm).ravel(), joint]
        if changed is not None:
            later = (np.arange(len(model)) >= changed)[:, None, None]
            parts.append(later * regressor[:, :, -10:] * LOAD_STD)
        return np.concatenate(parts, axis=2), model


def by_joint(columns: Sequence[Array]) -> Array:
    """(m, n, k n) of what acts on each joint alone, (m, n) each, one after the other."""
    m, n = columns[0].shape
    out = np.zeros((m, n, len(columns), n))
    for k, column in enumerate(columns):
        out[:, range(n), k, range(n)] = column
    return out.reshape(m, n, len(columns) * n)


def plausible_nm(model: Array) -> Array:
    """(n,) N m by which torques may be off a model's (m, n), where the search begins."""
    return np.asarray(FLOOR_NM + FLOOR_SHARE * np.sqrt(np.mean(model**2, axis=0)))


def sensor_nm(square: Array) -> Array:
    """(n,) N m of noise that is expected where torques have this mean square (n,)."""
    return np.asarray(SENSOR_NM + SENSOR_SHARE * np.sqrt(square))


def noise_nm(left: Array, samples: float | Array, expected: Array) -> Array:
    """(n,) N m of noise: by the mean square left of so many samples, and by what is expected."""
    total = samples * left + SENSOR_WEIGHT * expected**2
    return np.asarray(np.sqrt(total / (samples + SENSOR_WEIGHT)))


def lateness_s(signals: Sequence[Array], telling: Telling) -> float:
    """How much later than the motion torques come, s, where that is clear; 0 up to `LATE_S`.

    Friction that winds up over a small way comes late, too, where joints move slowly: torques that
    such friction explains as well are in time.

    Args:
        signals: q, dq, ddq, tau (m, n), 1 ms apart.
    """
    q, dq, ddq, tau = signals
    if len(q) < 2 * LATEST_MS + ROWS:
        return 0.0
    at = np.linspace(LATEST_MS, len(q) - 1 - LATEST_MS, ROWS).astype(int)
    rows = Rows(q[at], dq[at], ddq[at], tau[at])
    of = telling.explaining(rows)

    def cost(late_ms: int) -> float:
        return of(tau[at + late_ms]).cost

    late_ms = 0
    for step, reach in LATE_STEPS:
        late_ms = min((late_ms + step * k for k in range(-reach, reach + 1)), key=cost)
    if abs(late_ms) <= 1e3 * LATE_S or cost(late_ms) > cost(0) - EVIDENCE:
        return 0.0
    rival = telling.explained(telling.rubbing(rows, q, at)).cost
    if cost(late_ms) > rival - EVIDENCE:
        return 0.0
    at = np.linspace(LATEST_MS, len(q) - 1 - LATEST_MS, TURNS * ROWS).astype(int)
    for step, reach in LATE_STEPS[1:]:  # what winds up is late by itself
        rows = Rows(q[at], dq[at], ddq[at], tau[at + late_ms])
        of = telling.explaining(telling.rubbing(rows, q, at))
        near = (late_ms + step * k for k in range(-reach, reach + 1))
        late_ms = min((x for x in near if abs(x) <= LATEST_MS), key=cost)
    return 1e-3 * late_ms


def inertial_std(arm: RigidArm) -> Array:
    """(n, 10) plausible errors of a model's inertias, a payload on the last link among them."""
    theta = arm.theta
    mass = np.abs(theta[:, :1])
    first = INERTIA_SHARE * (np.abs(theta[:, 1:4]) + RADIUS_M * mass)
    second = INERTIA_SHARE * (np.abs(theta[:, 4:]) + RADIUS_M**2 * mass)
    std = np.concatenate([INERTIA_SHARE * mass, first, second], axis=1)
    std[-1] += LOAD_STD
    return np.asarray(std)


def explains_nothing(share: Array) -> bool:
    """Whether so small shares of the torques of moving joints are those of no arm of the model."""
    return bool(share.size and np.median(share) < EXPLAINED and share.max() < BEST_EXPLAINED)
