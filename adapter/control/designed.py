"""A motion that teaches most: sines of one period, chosen by the information they bring.

Each joint follows a Fourier series through where the arm stands,

    q(s) = q0 + sum_k a_k (cos(k w s) - 1) + b_k sin(k w s),

so that every limit is a set of linear inequalities on a joint's coefficients x = (a, b): they are
kept if its gauge, the largest of (linear function / limit), is at most one. Coefficients climb on

    f(x) = log det(H) / rank - MIX log trace(W H^-1) - EVEN log(trace(B) trace(B^-1)),
    H = known + seconds * information a second,   B = mean of Y'Y of the base parameters

(D-optimal; what is known worst counts more; and, where nothing is known yet, the condition number:
Swevers et al., Optimal robot excitation and identification, IEEE T-RA 13, 1997), less a penalty
where links come too near to what they must not touch; after each step, coefficients outside the
limits are scaled back onto them. The true extremes of a period are held against the limits, where
a random motion, which never repeats, has to hold sums of amplitudes against them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from adapter.control.free_path import SAME_START, ArmInCell
from adapter.control.information import Information
from adapter.control.limits import MotionLimits
from adapter.control.path_motion import (
    SineMotion,
    largest,
    moving,
    ramp_pairs,
    ramped,
    usable_range,
)
from adapter.control.settings import ExcitationSettings
from adapter.model.spatial import Array

TABLE_PER_WAVE, GRID_PER_WAVE = 12, 32  # instants of the information and of the limits, a wave
STEPS, FIRST_STEP = 150, 0.1  # rounds, and rad/s of the first
MIX, EVEN = 0.3, 0.6
MOMENTUM, MEMORY = 0.8, 0.95
# Of the speed that is allowed: a designed motion reaches it, and an arm lags and overshoots.
SPEED_ROOM = 0.8
LEAST_ROOM = 0.02  # rad that a joint at the edge of what it may use is still given
NEAR_LOOKS, NEAR_WEIGHT, MORE_M = 24, 50.0, 0.02  # poses a round; 1/m²; beyond the margin
DIFFERENCE = 1e-5
SHRINK, SMALLER = 0.95, 60  # where a motion is not free, and how often at most

# Sum over poses (m, n) of squared shortfalls of distance, m², and its gradient (m, n).
TooNear = Callable[[Array], tuple[float, Array]]


class Basis(NamedTuple):
    """Values at some instants of what the coefficients multiply, (m, 2 k) each, derivative by
    derivative."""

    q: Array
    dq: Array
    ddq: Array
    jerk: Array


def _basis(omega: Array, count: int) -> Basis:
    """Over one period, evenly, count instants; omega (k,) rad/s, the first one its own."""
    angle = np.outer(2.0 * np.pi * np.arange(count) / count, omega / omega[0])
    c, s = np.cos(angle), np.sin(angle)
    return Basis(
        np.hstack([c - 1.0, s]),
        np.hstack([-s * omega, c * omega]),
        np.hstack([-c * omega**2, -s * omega**2]),
        np.hstack([s * omega**3, -c * omega**3]),
    )


class DesignedMotion(SineMotion):
    """A motion of given coefficients that starts at rest at q0.

    Args:
        q0: (n,) rad; omega: (k,) rad/s, multiples of the first; x: (n, 2 k) coefficients, rad.
        settings: of the start, the stop and the rests.
    """

    def __init__(self, q0: Array, omega: Array, x: Array, settings: ExcitationSettings) -> None:
        super().__init__(q0, settings)
        a, b = np.split(x, 2, axis=1)
        self.centre, self.amplitude = q0 - a.sum(axis=1), np.hypot(a, b)
        self.omega, self.phase = np.tile(omega, (len(q0), 1)), np.arctan2(a, b)
        self._bounds = _bounds(q0, omega, x, settings)

    @property
    def period_s(self) -> float:
        """After which the path repeats, s of path time."""
        return float(2.0 * np.pi / self.omega[0, 0])

    def bounds(self) -> tuple[Array, Array, Array, Array, Array]:
        """See the base class."""
        return self._bounds

    def table(self, count: int) -> tuple[Array, Array, Array]:
        """q, q', q'' (count, n) over one period, evenly."""
        instants = np.arange(count) * self.period_s / count
        q, dq, ddq = np.moveaxis(np.array([self.path(s).copy() for s in instants]), 1, 0)
        return q.copy(), dq.copy(), ddq.copy()


def _bounds(
    q0: Array, omega: Array, x: Array, settings: ExcitationSettings
) -> tuple[Array, Array, Array, Array, Array]:
    """What a motion never leaves; between two instants of the grid a curve can rise by at most
    the step squared over eight times its second derivative."""
    count = GRID_PER_WAVE * len(omega)
    grid = _basis(omega, count)
    square = (2.0 * np.pi / omega[0] / count) ** 2 / 8.0
    a, b = np.split(x, 2, axis=1)
    size = np.hypot(a, b)
    more = [square * (size * omega ** (k + 2)).sum(axis=1) for k in range(4)]
    values = [part @ x.T for part in grid]
    speed, acceleration, jerk = (
        np.abs(value).max(axis=0) + extra for value, extra in zip(values[1:], more[1:], strict=True)
    )
    ramps = ramp_pairs(settings) @ np.array([acceleration, speed])
    jerk = ramped(speed, acceleration, jerk, settings)[2]
    lower, upper = q0 + values[0].min(axis=0) - more[0], q0 + values[0].max(axis=0) + more[0]
    return lower, upper, speed, ramps.max(axis=0), jerk


class Gauge:
    """How much of what the limits allow coefficients use, joint by joint.

    Args:
        limits: to keep; q0: (n,) rad; settings: shares of the limits; omega: (k,) rad/s.
    """

    def __init__(
        self, limits: MotionLimits, q0: Array, settings: ExcitationSettings, omega: Array
    ) -> None:
        lower, upper = usable_range(limits, q0, settings)
        self._grid = _basis(omega, GRID_PER_WAVE * len(omega))
        self._up = np.maximum(upper - q0, np.minimum(LEAST_ROOM, 0.5 * (limits.upper - q0)))
        self._down = np.maximum(q0 - lower, np.minimum(LEAST_ROOM, 0.5 * (q0 - limits.lower)))
        self._width = settings.range_share * (upper - lower)
        self._up, self._down = np.fmax(self._up, 1e-9), np.fmax(self._down, 1e-9)
        self._limits = limits
        self._velocity = SPEED_ROOM * settings.share * limits.velocity
        self._ramps, self._settings = ramp_pairs(settings), settings

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """(n,) gauges, and the linear functions (n, 2 k) that they are where they are largest."""
        values = [part @ x.T for part in self._grid]
        joints = np.arange(len(x))
        top, foot = values[0].argmax(axis=0), values[0].argmin(axis=0)
        turned = []
        for part, value in zip(self._grid[1:], values[1:], strict=True):
            at = np.abs(value).argmax(axis=0)
            turned.append(part[at] * np.sign(value[at, joints])[:, None])
        speed, acceleration, jerk = turned
        high, low = self._grid.q[top], self._grid.q[foot]
        share, limits = self._settings.share, self._limits
        most = share * limits.acceleration, share * limits.jerk
        rows = [
            high / self._up[:, None],
            -low / self._down[:, None],
            (high - low) / self._width[:, None],
            speed / self._velocity[:, None],
            *((r * acceleration + d * speed) / most[0][:, None] for r, d in self._ramps),
            ramped(speed, acceleration, jerk, self._settings)[2] / most[1][:, None],
        ]
        table = np.array([(row * x).sum(axis=1) for row in rows])
        worst = table.argmax(axis=0)
        return table[worst, joints], np.array(rows)[worst, joints]

    def inside(self, x: Array) -> Array:
        """Coefficients scaled back onto the limits where they are beyond them."""
        used, _ = self(x)
        return x / np.maximum(used, 1.0)[:, None]


@dataclass
class Designer:
    """Draws motions that teach most; what `run` and `excite` draw by.

    Attributes:
        information: of the arm.
        known: (rank, rank) information that is there already; None for none.
        seconds: of the motion, for the sum with `known`.
        too_near: what keeps links away from what they must not touch; nothing where None.
        free: whether a motion does so all along; a motion that does not is made smaller.
        meanwhile: called every few milliseconds, so that an arm's samples can be read.
        steps: rounds of climbing.
    """

    information: Information
    known: Array | None = None
    seconds: float = 10.0
    too_near: TooNear | None = None
    free: Callable[[SineMotion], bool] = field(default=lambda motion: True)
    meanwhile: Callable[[], None] = field(default=lambda: None)
    steps: int = STEPS
    _last: tuple[Array, ExcitationSettings, Array] | None = None

    def within(self, arm: ArmInCell) -> Designer:
        """The same that keeps an arm's links clear of its cell and of each other."""
        margin = arm.cell.margin

        def free(motion: SineMotion) -> bool:
            period_s = 2.0 * np.pi / motion.omega[0, 0]
            return arm.clearance(motion, period_s, margin).distance >= margin

        def too_near(q: Array) -> tuple[float, Array]:
            return arm.too_near(q, margin + MORE_M)

        return replace(self, too_near=too_near, free=free, meanwhile=lambda: arm.meanwhile())

    def __call__(
        self,
        limits: MotionLimits,
        q0: Array,
        settings: ExcitationSettings | None = None,
        attempt: int = 0,
        size: float = 1.0,
    ) -> DesignedMotion:
        """A motion from q0 (n,) rad, the same for the same seed.

        Args:
            limits: to keep; settings: of the motion.
            attempt: has no say: what is not free is made smaller, and seldom gets better.
            size: share of the motion found.

        Raises SettingsError as `RandomMotion` does.
        """
        settings = settings or ExcitationSettings()
        q0 = np.array(q0, dtype=np.float64)
        omega = _harmonics(settings)
        if self._last is not None:
            before, what, x = self._last
            if what == settings and np.abs(q0 - before).max() < SAME_START:
                return self._motion(limits, q0, settings, size * x)
        gauge = Gauge(limits, q0, settings, omega)
        moves = moving(limits, settings).astype(bool)
        rng = np.random.default_rng(settings.seed)
        x = rng.normal(size=(len(q0), 2 * len(omega))) / np.tile(omega, 2) * moves[:, None]
        x /= np.maximum(gauge(x)[0], 1e-9)[:, None]
        x = self._climb(gauge, q0, omega, x, rng)
        for _ in range(SMALLER):
            if self.free(self._motion(limits, q0, settings, x)):
                break
            x = SHRINK * x
        self._last = q0, settings, x
        return self._motion(limits, q0, settings, size * x)

    def _motion(
        self, limits: MotionLimits, q0: Array, settings: ExcitationSettings, x: Array
    ) -> DesignedMotion:
        omega = _harmonics(settings)
        return DesignedMotion(q0, omega, _within(limits, q0, omega, x, settings), settings)

    def _climb(
        self, gauge: Gauge, q0: Array, omega: Array, x: Array, rng: np.random.Generator
    ) -> Array:
        """Gradient ascent with momentum, a step size for each joint that shrinks to nothing."""
        table = _basis(omega, TABLE_PER_WAVE * len(omega))
        speeds, moves = np.tile(omega, 2), np.any(x, axis=1)
        best, best_x = -np.inf, x
        mean, square = np.zeros_like(x), np.zeros((len(x), 1))
        for k in range(self.steps):
            value, slope = self._slope(q0, table, x, rng)
            if value > best:
                best, best_x = value, x
            used, along = gauge(x)
            outwards = np.where(used > 0.98, (slope * x).sum(axis=1), 0.0)
            slope -= along * (np.maximum(outwards, 0.0) / np.maximum(used, 1e-9))[:, None]
            slope = slope * moves[:, None] / speeds
            mean = MOMENTUM * mean + (1.0 - MOMENTUM) * slope
            square = MEMORY * square + (1.0 - MEMORY) * (slope**2).mean(axis=1, keepdims=True)
            scale = np.sqrt(square / (1.0 - MEMORY ** (k + 1))) + 1e-12
            step = FIRST_STEP * (1.0 - k / self.steps) / (1.0 - MOMENTUM ** (k + 1))
            x = gauge.inside(x + step * mean / scale / speeds)
        return best_x

    def _slope(
        self, q0: Array, table: Basis, x: Array, rng: np.random.Generator
    ) -> tuple[float, Array]:
        """f and its gradient (n, 2 k).

        f depends on the motion through H and B alone, sums over rows y y', so its gradient is that
        of the sum of y' G y, G being the derivative of f by the sum; that is differentiated by
        differences, one signal of one joint in all instants at a time.
        """
        motion = q0 + table.q @ x.T, table.dq @ x.T, table.ddq @ x.T
        told, count = self.information, len(table.q)
        samples = self.seconds * told.samples_per_s
        Z, U = told.rows(*motion)
        # f, and its derivatives by both matrices
        H = told.prior + samples * (Z.T @ Z) / count
        if self.known is not None:
            H = H + self.known
        C, W, B = np.linalg.inv(H), told.in_wanted_units, U.T @ U / count
        B = B + 1e-9 * np.trace(B) * np.eye(len(B))  # of joints that stand nothing shows some
        D = np.linalg.inv(B)
        even = EVEN if self.known is None else 0.0
        left, most, least = (float(np.trace(part)) for part in (W @ C, B, D))
        value = float(np.linalg.slogdet(H)[1]) / len(H) - MIX * np.log(left)
        value -= even * np.log(most * least)
        of_H = C / len(H) + (MIX / left) * (C @ W @ C)
        of_own = even * (D @ D / least - np.eye(len(B)) / most)
        slope = np.zeros_like(x)

        G = told.on_rows(samples / count * of_H, of_own / count)

        def gains() -> Array:
            self.meanwhile()
            Y = told.regressor(*motion).swapaxes(0, 1)
            return np.asarray(((Y @ G) * Y).sum(axis=(0, 2)))

        before = gains()
        for signal, own in zip(motion, (table.q, table.dq, table.ddq), strict=True):
            for j in np.flatnonzero(np.any(x, axis=1)):
                signal[:, j] += DIFFERENCE
                slope[j] += own.T @ (gains() - before) / DIFFERENCE
                signal[:, j] -= DIFFERENCE
        if self.too_near is not None:
            chosen = (rng.random() + np.arange(NEAR_LOOKS)) * count / NEAR_LOOKS
            chosen = chosen.astype(int)
            short, push = self.too_near(motion[0][chosen])
            value -= NEAR_WEIGHT * short
            slope -= NEAR_WEIGHT * (push.T @ table.q[chosen])
        return value, slope


def _harmonics(settings: ExcitationSettings) -> Array:
    """(k,) rad/s: multiples of the lowest up to the highest frequency that is asked for."""
    lowest = max(settings.low_hz, settings.high_hz / 16)  # harmonics
    count = int(settings.high_hz / lowest + 1e-9)
    return np.asarray(2.0 * np.pi * lowest * np.arange(1, max(count, 1) + 1))


def _within(
    limits: MotionLimits, q0: Array, omega: Array, x: Array, settings: ExcitationSettings
) -> Array:
    """Coefficients that keep every limit for sure, between the grid's instants, too, and where
    a joint's speed limit depends on where it is."""
    lower, upper = usable_range(limits, q0, settings)
    share = settings.share

    def allowed(factor: Array) -> Array:
        low, high, speed, acceleration, jerk = _bounds(q0, omega, factor[:, None] * x, settings)
        return np.asarray(
            (low >= np.minimum(lower, q0) - 1e-12)
            & (high <= np.maximum(upper, q0) + 1e-12)
            & (high - low <= settings.range_share * (upper - lower))
            & (speed <= SPEED_ROOM * share * limits.speed_between(low, high))
            & (acceleration <= share * limits.acceleration)
            & (jerk <= share * limits.jerk)
        )

    return x * largest(np.ones(len(x)), allowed)[:, None]
