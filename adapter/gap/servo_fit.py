"""Servos from commanded and measured positions: by equation error first, then by output error.

Each joint is simulated alone, under its commands and the load that the others' motion puts on it;
then all joints together, whose motion, free of noise, gives the load for a second round.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from adapter.gap import servo_kernels as col
from adapter.gap.servo_kernels import SLIP, Load, follow_alone
from adapter.gap.servo_signals import Track, smoothed
from adapter.model.spatial import Array

PARAMETERS, PLAIN = 12, 5  # in all; those that an equation without limits has
# where edges of limits (of the most that a motion took, at `FULL` of its rows) and of dead bands
# (shares of rows) start, and how far beyond the latter what is driven is free of chatter
FULL, LIMITED, DULL, BEYOND = 0.98, (1.1, 0.9, 0.7), (0.05, 0.15, 0.3, 0.5), 1.4
GONE = 0.02, 1.0  # rad/s or m/s, between which it is gone
SHAPE = 0.1  # of it, one standard deviation: what a line has other than curves that were measured
LATEST_S, EVERY_S = 0.05, 1e-3  # of the delays that are tried
USUAL_HZ = 5.0  # at which position loops of arms close: 1 to 20
BLOCK_S = 2.0  # of alternating blocks
MEMORY_S = 0.5  # beyond which what is left of a fit does not know itself
BY_GAIN = np.isin(
    np.arange(PARAMETERS), (col.LEAD, col.DAMPING, col.INERTIA, col.RUBS, col.STICKS)
)  # over kp
# scale of a parameter that is zero; WITHIN follows from the others
LEAST = np.array([1e-6, 2e-3, 2e-3, 2e-5, 1e-4, 1e-3, 1e-4, 0.3, 2e-4, 2e-4, 0.05, 1.0])
NUDGE = 1e-3  # of its scale, for derivatives
OUTLIER_RAD = 5e-3  # beyond which what the model does not know is no noise
FAR_RAD = 10.0  # at which a simulated motion that runs away is cut
ALIKE = 10.0  # factor by which a position gain is sought around its start, the other joints'
UNTOLD = 10.0  # scales, one standard deviation of what readings do not tell
ROUNDS, SETTLED, MILLI = 40, 1e-7, 1e3  # of a fit, at most; of its cost; it goes by mrad


@dataclass(frozen=True, eq=False)
class JointTask:
    """One joint on some recordings.

    Attributes:
        joint: from 0; tracks: the recordings; loads: of the joint on each.
        rows: for each track the (k,) readings that are fitted.
        usual: rad/(N m), one over the position gain that such servos have; 0 where not known. It
            tells the scale where the documented masses hardly load the joint.
    """

    joint: int
    tracks: Sequence[Track]
    loads: Sequence[Load]
    rows: Sequence[NDArray[np.bool_]]
    usual: float = 0.0

    def left(self, x: Array) -> list[Array]:
        """What (12,) parameters leave of each recording's readings (k,), rad."""
        found = []
        for track, load in zip(self.tracks, self.loads, strict=True):
            one = track.only(self.joint)
            goal, q = (
                one.goal(x[col.LEAD : col.LEAD + 1], x[col.DELAY])[..., 0],
                np.empty(len(one.t)),
            )
            follow_alone(x, goal, load, one.start[:, 0], track.step_s, q)
            found.append(one.left(q[:, None])[:, 0])
        return found

    def fitted(self, x: Array) -> Array:
        """What they leave of the readings that are fitted, rad; a motion that runs away is cut."""
        rows = zip(self.left(x), self.rows, strict=True)
        left = np.concatenate([left[take] for left, take in rows])
        return np.clip(np.nan_to_num(left, nan=FAR_RAD), -FAR_RAD, FAR_RAD)


@dataclass(frozen=True, eq=False)
class Freedom:
    """Which parameters are free, and what the others are.

    Attributes:
        free: (12,) bool.
        documented: (12,) of the fixed ones; those of `BY_GAIN` times the position
            gain, and `TIGHT` over it, in SI, so that they stay what they are while the gain is
            sought. `WITHIN` is a share of the damping, where no command's speed is fed forward.
    """

    free: NDArray[np.bool_]
    documented: Array

    def full(self, part: Array) -> Array:
        """(12,) from the free ones."""
        x = self.documented.copy()
        x[self.free] = part
        x[~self.free & BY_GAIN] *= x[col.A]
        if not self.free[col.TIGHT]:
            x[col.TIGHT] /= x[col.A] if x[col.A] > 0.0 else 1.0
        x[col.WITHIN] = x[col.LEAD] if x[col.LEAD] > 0.0 else x[col.WITHIN] * x[col.DAMPING]
        return x

    def beside(self, k: int, within: float | None) -> Freedom:
        """With one parameter more, and another share of the damping within the torque's limit."""
        free, documented = self.free.copy(), self.documented.copy()
        free[k] = True
        free[col.SLIPS] |= k == col.STICKS
        if within is not None:
            documented[col.WITHIN] = within
        return Freedom(free, documented)

    def without(self, k: int) -> Freedom:
        """With one parameter as documented."""
        free = self.free.copy()
        free[k] = False
        free[col.SLIPS] &= k != col.STICKS
        return replace(self, free=free)


ALL_FREE = Freedom(np.arange(PARAMETERS) <= col.DELAY, np.zeros(PARAMETERS))


@dataclass(frozen=True, eq=False)
class JointFit:
    """A joint's servo, fitted.

    Attributes:
        task, freedom: of what, and how; x: (12,).
        delay_std: s, of the delay that all joints share.
        values, doubt: (11,) in SI and (11, 11) their covariance, once they were weighed.
    """

    task: JointTask
    freedom: Freedom
    x: Array
    delay_std: float = 0.0
    values: Array = field(default_factory=lambda: np.zeros(col.WITHIN))
    doubt: Array = field(default_factory=lambda: np.zeros((col.WITHIN, col.WITHIN)))

    @cached_property
    def scale(self) -> Array:
        """(f,) of the free parameters."""
        return np.maximum(np.abs(self.x), LEAST)[self.freedom.free]

    @cached_property
    def jacobian(self) -> Array:
        """(r, f) of what is left by the free parameters, each in its scale."""
        return _slopes(self.task, self.freedom, self.x[self.freedom.free], self.scale)

    @cached_property
    def noise_covariance(self) -> Array:
        """(f, f) of the free parameters over their scales, by what is left unexplained.

        What the readings do not tell is known to some times its size: a direction that is left
        out would count as known for sure.
        """
        J = self.jacobian
        return np.asarray(np.linalg.inv(J.T @ J / self.unit + np.eye(J.shape[1]) / UNTOLD**2))

    @cached_property
    def unit(self) -> float:
        """Squares (rad²) that one unit of chi squared is worth, see `chi2_unit`."""
        return chi2_unit(self.task, self.x)

    def moved(self, others: Sequence[Array]) -> Array:
        """(s, f) by how much the parameters over their scales would move where this is left."""
        gain = -self.noise_covariance @ self.jacobian.T / self.unit
        return np.array([gain @ (left - self.task.fitted(self.x)) for left in others])

    def under(self, others: Sequence[Sequence[Load]]) -> Array:
        """(s, f) the same, under other loads."""
        return self.moved([replace(self.task, loads=x).fitted(self.x) for x in others])

    def error(self) -> float:
        """What it leaves of the readings that its task fits, rad², see `misfit`."""
        return misfit(self.task.fitted(self.x))


def chi2_unit(task: JointTask, x: Array) -> float:
    """Squares (rad²) that one unit of chi squared is worth, neighbours knowing each other."""
    most = 1.0
    # how many neighbours tell as much as one that knows nothing of its neighbours
    for left, track, take in zip(task.left(x), task.tracks, task.rows, strict=True):
        own = np.where(take, left, 0.0)
        lags = max(int(MEMORY_S / np.median(np.diff(track.stamp_s))), 1)
        size = 1 << int(np.ceil(np.log2(2 * len(own))))
        power = np.fft.irfft(np.abs(np.fft.rfft(own, size)) ** 2)[:lags]
        share = power / max(power[0], 1e-30)
        below = np.flatnonzero(share < 0.05)
        most = max(most, 1.0 + 2.0 * float(share[1 : below[0] if below.size else lags].sum()))
    left = task.fitted(x)
    return misfit(left) / len(left) * most


def misfit(left: Array) -> float:
    """Sum of squares (rad²) of what is left, that of outliers growing by their size alone."""
    return float(2.0 * OUTLIER_RAD**2 * np.sum(np.sqrt(1.0 + (left / OUTLIER_RAD) ** 2) - 1.0))


def blocks(task: JointTask, part: int) -> JointTask:
    """On every second block of time."""
    pairs = zip(task.tracks, task.rows, strict=True)
    rows = [take & ((track.stamp_s // BLOCK_S).astype(int) % 2 == part) for track, take in pairs]
    return replace(task, rows=rows)


def robust_fit(
    left: Callable[[Array], Array],
    slopes: Callable[[Array, Array], Array],
    z: Array,
    ends: Sequence[Array],
    most: tuple[int, float],
    priors: int,
) -> tuple[Array, float]:
    """Levenberg's and Marquardt's steps from z (k,), within both `ends`; also the cost.

    After so many rounds at `most`, or where one gains less than a share of the cost. The last rows
    are of `priors`, which hold however far off they are: no outliers.

    By products of the slopes' columns: scipy decomposes the whole of them at each step, which takes
    ten times as long where there are 50 000 readings and 50 numbers.
    """

    def cost_of(rows: Array) -> float:
        rows = rows / MILLI
        return misfit(rows[:count]) + float(np.sum(rows[count:] ** 2))

    rows, damping = left(z), 1e-3
    count = len(rows) - priors
    cost = cost_of(rows)
    for _ in range(most[0]):
        J, weight = slopes(z, rows), 1.0 / np.sqrt(1.0 + (rows / MILLI / OUTLIER_RAD) ** 2)
        weight[count:] = 1.0
        G, g = J.T @ (weight[:, None] * J), J.T @ (weight * rows)
        before = cost
        while damping < 1e6:
            free = ~(((z <= ends[0]) & (g > 0.0)) | ((z >= ends[1]) & (g < 0.0)))
            H = G[np.ix_(free, free)]
            step = np.zeros_like(z)
            step[free] = np.linalg.solve(H + np.diag(damping * np.diagonal(H) + 1e-9), -g[free])
            trial = np.clip(z + step, *ends)
            moved = left(trial)
            if (after := cost_of(moved)) < cost:
                z, rows, cost, damping = trial, moved, after, damping / 5.0
                break
            damping *= 5.0
        if before - cost < most[1] * before:
            break
    return z, cost


def fit_joint(task: JointTask, freedom: Freedom, start: Array) -> JointFit:
    """Fit by output error from (12,) parameters on."""
    x = start.copy()
    scale = np.maximum(np.abs(x), LEAST)[freedom.free]
    if not freedom.free.any():
        return JointFit(task, freedom, freedom.full(x[freedom.free]))

    prior = task.usual > 0.0 and x[col.A] > 0.0 and bool(freedom.free[col.A])
    held = MILLI * np.sqrt(chi2_unit(task, x)) / np.log(ALIKE) if prior else 0.0

    def left(z: Array) -> Array:
        own = freedom.full(z * scale)
        rows = task.fitted(own) * MILLI
        return np.append(rows, held * np.log(own[col.A] / task.usual)) if prior else rows

    def slopes(z: Array, here: Array) -> Array:
        rows = _slopes(task, freedom, z * scale, scale) * MILLI
        return np.vstack([rows, (np.arange(len(z)) == 0) * held / z[0]]) if prior else rows

    low, high = np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf)
    low[col.SLIPS], high[col.SLIPS] = GONE
    if x[col.A] > 0.0:  # what the masses hardly load tells no gain
        low[col.A], high[col.A] = x[col.A] / ALIKE, x[col.A] * ALIKE
    ends = low[freedom.free] / scale, high[freedom.free] / scale
    begin = np.clip(x[freedom.free] / scale, *ends)
    found, _ = robust_fit(left, slopes, begin, ends, (ROUNDS, SETTLED), int(prior))
    return JointFit(task, freedom, freedom.full(found * scale))


def _slopes(task: JointTask, freedom: Freedom, part: Array, scale: Array) -> Array:
    found = []
    for k in range(len(part)):
        step = np.zeros(len(part))
        step[k] = NUDGE * scale[k]
        low = part - step if part[k] > step[k] else part
        above, below = task.fitted(freedom.full(part + step)), task.fitted(freedom.full(low))
        found.append((above - below) / (part[k] + step[k] - low[k]) * scale[k])
    return np.column_stack(found)


def first_guess(task: JointTask) -> Array:
    """(12,) by equation error on smooth signals, the delay by trying."""
    best, least, equation = np.zeros(PARAMETERS), np.inf, equations(task)
    for delay in np.arange(0.0, LATEST_S, EVERY_S):
        matrix, wanted = equation(delay)
        x, left = _solved(matrix[:, :PLAIN], wanted)
        if left < least:
            least, best = left, np.array([*x, delay, *np.zeros(PARAMETERS - col.DELAY - 1)])
    if best[col.A] < LEAST[col.A]:  # a servo that no load moves: the equation does not hold
        mass = np.median(np.concatenate([load.mass for load in task.loads]))
        best[col.A] = 1.0 / (mass * (2.0 * np.pi * USUAL_HZ) ** 2)
    return best


def guesses(equation: Callable[[float], tuple[Array, Array]], x: Array, k: int) -> list[Array]:
    """Starts (12,) of a fit with one number more, k, beside those that there are, x (12,).

    Where a limit or a dead band acts, the equation does not hold; so the rest tells the others.
    """
    matrix, wanted = equation(x[col.DELAY])
    if k == col.PLAY:
        (*found, play), _ = _solved(matrix, wanted)
        return [np.array([*found, *x[col.DELAY : col.PLAY], play, *x[col.SLIPS :]])]
    if k == col.STICKS:
        start = np.where(np.arange(PARAMETERS) == col.STICKS, 0.3 * x[col.RUBS], x)
        return [np.where(np.arange(PARAMETERS) == col.SLIPS, x, start) for x in (SLIP / 4.0, SLIP)]
    asked, starts = np.abs(wanted), []
    if k == col.TIGHT:  # what the joint's motion took is no more than the limit, whatever was asked
        calm = np.abs(wanted) < np.median(np.abs(wanted))
        x = np.array([*_solved(matrix[calm, :PLAIN], wanted[calm])[0], *x[col.DELAY :]])
        x[col.WITHIN] = x[col.LEAD] if x[col.LEAD] > 0.0 else x[col.DAMPING]
        beside = np.array(
            [x[col.A], 0.0, x[col.DAMPING] - x[col.WITHIN], x[col.INERTIA], x[col.RUBS]]
        )
        most = float(np.quantile(np.abs(matrix[:, :PLAIN] @ beside), FULL))
        asked = np.abs(
            wanted - x[col.LEAD] * matrix[:, col.LEAD] - x[col.WITHIN] * matrix[:, col.DAMPING]
        )
        edges = [most * share for share in LIMITED]
    else:
        edges = np.quantile(asked, DULL).tolist()
    for edge in edges:
        rows, own = asked < edge if k == col.TIGHT else asked > BEYOND * edge, x.copy()
        own[:PLAIN], _ = _solved(matrix[rows, :PLAIN], wanted[rows])
        same = x.copy()
        own[k] = same[k] = 1.0 / max(edge, 1e-6) if k == col.TIGHT else edge
        starts += [own, same]
    return starts


def _solved(matrix: Array, wanted: Array) -> tuple[Array, float]:
    """Non-negative least squares, and what is left."""
    size = np.maximum(np.sqrt(np.mean(matrix**2, axis=0)), 1e-12)
    # the triangle of all rows is as good as they are, and small
    rows = np.asarray(np.linalg.qr(np.column_stack([matrix / size, wanted]), mode="r"))
    x, left = nnls(rows[:, :-1], rows[:, -1])
    return x / size, float(left)


def equations(task: JointTask) -> Callable[[float], tuple[Array, Array]]:
    """Of all recordings, by the delay, see `_equation`."""
    pairs = zip(task.tracks, task.loads, strict=True)
    each = [_equation(track, load, task.joint) for track, load in pairs]

    def at(delay: float) -> tuple[Array, Array]:
        matrix, wanted = zip(*(one(delay) for one in each), strict=True)
        return np.concatenate(matrix), np.concatenate(wanted)

    return at


def _equation(track: Track, load: Load, joint: int) -> Callable[[float], tuple[Array, Array]]:
    """Of a servo, every 5 ms, by its delay: columns (m, 6) and what they are to add up to (m,).

    The last column is that of half the backlash.
    """
    period = float(np.median(np.diff(track.stamp_s)))
    one = track.only(joint)
    command = smoothed(one.goal(np.zeros(1), 0.0)[0], track.step_s, period)[:2, :, 0]
    q, dq, ddq = 0.5 * (track.smooth[:, 1:, joint] + track.smooth[:, :-1, joint])
    matrix = np.zeros((len(q), PLAIN + 1))
    matrix[:, PLAIN] = load.side
    matrix[:, col.A] = load.mass * ddq + load.other
    matrix[:, col.DAMPING], matrix[:, col.INERTIA], matrix[:, col.RUBS] = (
        dq,
        ddq,
        np.tanh(dq / 0.01),
    )
    middle = track.t - 0.5 * track.step_s
    edge = (middle > 0.5) & (middle < middle[-1] - 0.3)
    take = np.flatnonzero(edge)[:: max(round(5e-3 / track.step_s), 1)]

    def at(delay: float) -> tuple[Array, Array]:
        goal, rate = (np.interp(middle[take] - delay, middle, row) for row in command)
        columns = matrix[take]
        columns[:, col.LEAD] = -rate
        return columns, goal - q[take]

    return at
