"""Joint frames of a tree from gyroscopes and accelerometers on its links, mounted anyhow.

Unknown are the joint frames, where each sensor sits on its link, the biases of its gyroscope and
of its accelerometer, and by how much its stamps are late. Known are the joints' positions, gravity
and which link each sensor is on. All are found together, by Gauss-Newton on two equations of each
sensor s on link i in each window (see `imu_windows`), in axes of the base:

    ∫ w [S (ω - b_ω) - Σ_j z_j dq_j] dt = 0
    ∫ w S (a - b_a) dt - ∫ w'' (p_i + R_i r) dt + g = 0

with S = R_i R_m the sensor's orientation and r its place on the link. Links without a sensor need
none: their joints stand in the chain between two sensors.

No sensor mounted anyhow shows where a link's frame lies along its own axis and how it is turned
about it; there each frame keeps what it started with (a gauge). What else the data do not show
stays there too, drawn by springs so weak that they bend nothing that is shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from adapter.learning.imu_windows import BELL, BEND, OVERLAP, Course, Readings, Sums, Windows
from adapter.model.spatial import Array, exp_rotation, log_rotation, rot_z, skew
from adapter.model.tree import BASE, Tree

# Springs towards the start: standard deviations of a frame's turn (rad) and shift (m), of a
# sensor's place (m), biases (rad/s, m/s²) and the lateness of its stamps (s).
FRAME_STD, PLACE_STD, W_BIAS_STD, A_BIAS_STD, LATE_STD = 0.3, 1.0, 0.1, 1.0, 0.05
OWN = 13  # unknowns of a sensor: turn, place, biases of w and a, lateness
LEAST_STD = 1e-9  # rad/s, m/s²: no sensor is trusted more
WILD = 6.0  # standard deviations; a window that is further off is not believed
FIRST_DAMPING, MOST_DAMPING = 1e-6, 1.0


@dataclass(frozen=True)
class Estimate:
    """Frames of the joints, and the sensors.

    Attributes:
        R0, p: (n, 3, 3), (n, 3) m, frame j in frame i at q = 0.
        turn: (s, 3, 3) each sensor's axes in its link's; place: (s, 3) m.
        w_bias, a_bias: (s, 3) rad/s, m/s².
        late_s: (s,) by how much each sensor's stamps come after what it measured.
    """

    R0: Array
    p: Array
    turn: Array
    place: Array
    w_bias: Array
    a_bias: Array
    late_s: Array

    @classmethod
    def of(cls, R0: Array, p: Array, turn: Array) -> Estimate:
        """Frames, and sensors turned like this of which nothing else is known."""
        none = np.zeros((len(turn), 3))
        return cls(R0.copy(), p.copy(), turn, none, none, none, np.zeros(len(turn)))

    def arrays(self, prefix: str) -> dict[str, Array]:
        """By name, for a file."""
        return {prefix + field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], prefix: str) -> Estimate | None:
        """What `arrays` gave; None where it is not there."""
        if prefix + "R0" not in arrays:
            return None
        return cls(*(np.array(arrays[prefix + field.name]) for field in fields(cls)))

    def moved(self, step: Array) -> Estimate:
        """After a step (6 n + OWN s,): frames by [turn in own, shift in parents' axes], sensors."""
        n = len(self.p)
        frames, own = step[: 6 * n].reshape(n, 6), step[6 * n :].reshape(-1, OWN)
        return Estimate(
            self.R0 @ exp_rotation(frames[:, :3]),
            self.p + frames[:, 3:],
            self.turn @ exp_rotation(own[:, :3]),
            self.place + own[:, 3:6],
            self.w_bias + own[:, 6:9],
            self.a_bias + own[:, 9:12],
            self.late_s + own[:, 12],
        )

    def way_from(self, start: Estimate) -> tuple[Array, Array]:
        """(P,) the step from a start to here, and its slopes (P, P) as steps from here go on."""
        both = (start.R0, self.R0), (start.turn, self.turn)
        turns = [log_rotation(np.swapaxes(a, 1, 2) @ b) for a, b in both]
        apart = [getattr(self, x) - getattr(start, x) for x in ("place", "w_bias", "a_bias")]
        own = turns[1], *apart, (self.late_s - start.late_s)[:, None]
        frames = np.concatenate([turns[0], self.p - start.p], axis=1)
        way = np.r_[frames.ravel(), np.concatenate(own, axis=1).ravel()]
        slopes, n = np.eye(len(way)), len(self.p)
        first = [*range(0, 6 * n, 6), *range(6 * n, len(way), OWN)]
        for c, turn in zip(first, np.concatenate(turns), strict=True):
            k = skew(turn)  # of a logarithm, to second order
            slopes[c : c + 3, c : c + 3] += 0.5 * k + k @ k / 12.0
        return way, slopes


class Prior(NamedTuple):
    """What is known beside the readings, as a paraboloid: springs, and readings no longer held.

    Attributes:
        centre: where it is taken.
        gradient, curvature: (P,), (P, P) of half the cost there.
    """

    centre: Estimate
    gradient: Array
    curvature: Array

    @classmethod
    def springs(cls, start: Estimate) -> Prior:
        """Springs towards a start; none on the turns of sensors, which are anyhow."""
        own = np.repeat([np.inf, PLACE_STD, W_BIAS_STD, A_BIAS_STD], 3)
        own = np.tile(np.r_[own, LATE_STD], len(start.late_s))
        stiff = np.r_[np.full(6 * len(start.p), FRAME_STD), own] ** -2.0
        return cls(start, np.zeros_like(stiff), np.diag(stiff))

    def at(self, where: Estimate) -> Slope:
        """Cost, half its gradient, and curvature."""
        way, slopes = where.way_from(self.centre)
        bent = self.curvature @ way
        cost = float(way @ (bent + 2.0 * self.gradient))
        return Slope(cost, slopes.T @ (self.gradient + bent), slopes.T @ self.curvature @ slopes)


class Slope(NamedTuple):
    """A cost, half its gradient (P,), and its curvature (P, P)."""

    cost: float
    gradient: Array
    curvature: Array


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes:
        estimate: at the least cost.
        covariance: (P, P) of all unknowns, in the order of `Estimate.moved`; zero in the gauge.
        w_share: (s,) what is left of w in a window, as a share of how the sensor turned.
    """

    estimate: Estimate
    covariance: Array
    w_share: Array


class ImuFit:
    """The equations of some readings.

    Args:
        tree, gravity: of the robot; gravity (3,) m/s² in axes of the base.
        links: the link of each sensor.
        readings: of at least one window.
    """

    def __init__(
        self, tree: Tree, gravity: Array, links: tuple[int, ...], readings: Readings
    ) -> None:
        self.tree, self.gravity, self.links = tree, gravity, links
        joints = Course(readings.t_s, readings.q)
        self.windows = Windows.over(joints, readings.t_s)
        t_s = self.windows.t_s
        self.q, self.dq = joints.at(t_s), joints.rate(t_s)
        self._bell, self._bend = Sums(BELL, self.windows), Sums(BEND, self.windows)
        self._sensors, self._whole = [], []
        for s in range(len(links)):
            told = np.concatenate([readings.w[:, s], readings.a[:, s]], axis=1)
            heard = np.isfinite(told).all(axis=1)
            course = Course(readings.t_s[heard], told[heard])
            self._sensors.append(course)
            self._whole.append(self.windows.whole(course.heard(t_s)))

    @property
    def count(self) -> int:
        """Windows."""
        return len(self.windows.starts)

    def begin(self, R0: Array, p: Array) -> Estimate:
        """Sensors turned so that they turn and feel gravity as the links of given frames do."""
        arm, s = _Arm.of(self, R0, p), len(self.links)
        turn = np.empty((s, 3, 3))
        for k, i in enumerate(self.links):
            whole = self._whole[k]
            told = self._bell(self._sensors[k].at(self.windows.t_s))[whole]
            back = np.swapaxes(arm.R[:, i], 1, 2)
            spin = self._bell(np.einsum("gab,gb->ga", back, arm.spin(i, BASE)))[whole]
            up = self._bell(-back @ self.gravity)[whole]
            size = np.sqrt(np.mean(np.sum(spin**2, axis=1)) + 1e-12)
            wahba = (spin - spin.mean(axis=0)).T @ (told[:, :3] - told[:, :3].mean(axis=0))
            wahba = wahba / size**2 + up.T @ told[:, 3:] / float(self.gravity @ self.gravity)
            u, _, vt = np.linalg.svd(wahba)
            turn[k] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        return Estimate.of(R0, p, turn)

    def solve(self, prior: Prior, at: Estimate) -> Fit:
        """Gauss-Newton from `at`, damped where a step does not lower the cost."""
        damping = 0.0
        stds, slope = self._slope(at, prior)
        for _ in range(30):
            free = self._free(at)
            H = free.T @ slope.curvature @ free
            damped = H + damping * np.diag(H.diagonal())
            step = -free @ np.linalg.solve(damped, free.T @ slope.gradient)
            trial = at.moved(step)
            if self._cost(trial, stds, prior) > slope.cost * (1.0 + 1e-9):
                damping = max(10.0 * damping, FIRST_DAMPING)
                if damping > MOST_DAMPING:
                    break
                continue
            at, damping = trial, 0.1 * damping if damping > FIRST_DAMPING else 0.0
            stds, slope = self._slope(at, prior)
            if float(step @ slope.curvature @ step) < 0.1**2:  # in standard deviations
                break
        free = self._free(at)
        covariance = free @ np.linalg.inv(free.T @ slope.curvature @ free) @ free.T
        share = np.zeros(len(self.links))
        for k, course in enumerate(self._sensors):
            w = self._bell(course.at(self.windows.t_s)[:, :3])[self._whole[k]]
            share[k] = stds[k, 0] / max(float(np.sqrt(np.mean((w - w.mean(axis=0)) ** 2))), 1e-12)
        return Fit(at, covariance, share)

    def known(self, prior: Prior, at: Estimate) -> Prior:
        """All that a prior and these readings say, for when the readings are no longer held."""
        _, slope = self._slope(at, prior)
        return Prior(at, slope.gradient, slope.curvature)

    def _free(self, at: Estimate) -> Array:
        """(P, F) orthonormal, all steps but those along the gauge."""
        n, s = self.tree.n, len(self.links)
        basis = np.eye(6 * n + OWN * s)
        kept = np.ones(len(basis), dtype=bool)
        for j in range(n):
            basis[6 * j + 3 : 6 * j + 6, 6 * j + 3 : 6 * j + 6] = at.R0[j]
            kept[[6 * j + 2, 6 * j + 5]] = False
        basis = basis[:, kept]
        gauge = basis.T @ np.pad(base_gauge(self.tree, self.gravity, at), ((0, OWN * s), (0, 0)))
        rest, _ = np.linalg.qr(gauge, mode="complete")
        return np.asarray(basis @ rest[:, gauge.shape[1] :])

    def _cost(self, at: Estimate, stds: Array, prior: Prior) -> float:
        arm, total = _Arm.of(self, at.R0, at.p), prior.at(at).cost
        for k, levels in enumerate(stds):
            for x, std in zip(self._residual(arm, at, k)[:2], levels, strict=True):
                total += float(np.minimum((x / std) ** 2, WILD**2).sum()) / OVERLAP
        return total

    def _residual(self, arm: _Arm, at: Estimate, k: int) -> tuple[Array, Array, _Felt]:
        """What is left of w and a (windows, 3) of sensor k, and what it felt."""
        felt = _Felt.of(self, arm, at, k)
        whole, i = self._whole[k], self.links[k]
        w = self._bell(felt.w - arm.spin(i, BASE))[whole]
        a = (self._bell(felt.a) - self._bend(felt.place))[whole] + self.gravity
        return w, a, felt

    def _slope(self, at: Estimate, prior: Prior) -> tuple[Array, Slope]:
        """(s, 2) what is left of w and a of each sensor, and the slope of the whole cost."""
        arm, stds = _Arm.of(self, at.R0, at.p), np.empty((len(self.links), 2))
        cost, gradient, curvature = prior.at(at)
        for k in range(len(self.links)):
            for c, rows in enumerate(self._linearised(arm, at, k)):
                left = rows[:, 0]
                usual = max(1.4826 * float(np.median(np.abs(left))), LEAST_STD)
                sound = np.abs(left) < WILD * usual
                std = stds[k, c] = max(float(np.sqrt(np.mean(left[sound] ** 2))), LEAST_STD)
                moments = rows[sound].T @ rows[sound] / (std**2 * OVERLAP)
                cost += float(np.minimum((left / std) ** 2, WILD**2).sum()) / OVERLAP
                gradient = gradient + moments[0, 1:]
                curvature = curvature + moments[1:, 1:]
        return stds, Slope(cost, gradient, curvature)

    def _linearised(self, arm: _Arm, at: Estimate, k: int) -> list[Array]:
        """Rows [what is left | its slopes] (3 windows, 1 + P) of w and of a of sensor k.

        What is left is told in the sensor's axes in the middle of the window, of which its size
        does not depend: else a turn of the whole robot about gravity, which turns what noise left,
        would pass for something that data show.
        """
        w, a, felt = self._residual(arm, at, k)
        whole, i, n = self._whole[k], self.links[k], self.tree.n
        middle = (self.windows.starts + len(BELL) // 2)[whole]
        by = np.zeros((2, len(w), 3, 1 + 6 * n + OWN * len(self.links)))
        by[0, :, :, 0], by[1, :, :, 0] = w, a
        own = 1 + 6 * n + OWN * k
        turns = [
            (1 + 6 * j, arm.axes[:, j], arm.spin(i, j), arm.p[:, j]) for j in self.tree.path_to(i)
        ]
        turns.append((own, felt.axes, np.zeros_like(felt.w), felt.place))
        for c, axes, spin, p in turns:
            for b, x in enumerate((felt.w - spin, felt.a)):
                by[b, :, :, c : c + 3] = self._bell(_turned(x, axes))[whole]
                by[b, :, :, c : c + 3] -= _turned((w, a)[b], axes[middle])
            by[1, :, :, c : c + 3] -= self._bend(_turned(felt.place - p, axes))[whole]
        for j in self.tree.path_to(i):
            if self.tree.parent[j] != BASE:  # a shift of all changes nothing
                shift = -self._bend(arm.R[:, self.tree.parent[j]])[whole]
                by[1, :, :, 1 + 6 * j + 3 : 1 + 6 * j + 6] = shift
        by[1, :, :, own + 3 : own + 6] = -self._bend(arm.R[:, i])[whole]
        bias = -self._bell(felt.axes)[whole]
        by[0, :, :, own + 6 : own + 9] = by[1, :, :, own + 9 : own + 12] = bias
        by[0, :, :, own + 12] = self._bell(felt.w_rate)[whole]
        by[1, :, :, own + 12] = self._bell(felt.a_rate)[whole]
        return [x.reshape(3 * len(w), -1) for x in by]


@dataclass(frozen=True)
class _Arm:
    """Where the links are on the grid: R (g, n, 3, 3), p (g, n, 3), `axes` those of the joints'
    frames before they turn (g, n, 3, 3), and `turning` what each joint adds to w (g, n, 3)."""

    R: Array
    p: Array
    axes: Array
    turning: Array
    parent: tuple[int, ...]

    @classmethod
    def of(cls, fit: ImuFit, R0: Array, p0: Array) -> _Arm:
        g, n = fit.q.shape
        R, axes, p = np.empty((g, n, 3, 3)), np.empty((g, n, 3, 3)), np.empty((g, n, 3))
        for j, i in enumerate(fit.tree.parent):
            if i == BASE:
                axes[:, j], p[:, j] = R0[j], p0[j]
            else:
                axes[:, j], p[:, j] = R[:, i] @ R0[j], p[:, i] + R[:, i] @ p0[j]
            R[:, j] = axes[:, j] @ rot_z(fit.q[:, j])
        return cls(R, p, axes, axes[..., 2] * fit.dq[..., None], fit.tree.parent)

    def spin(self, link: int, joint: int) -> Array:
        """(g, 3) what the joints from `joint` (BASE: all) to a link add to its angular velocity."""
        total = np.zeros_like(self.p[:, 0])
        while link != BASE:
            total += self.turning[:, link]
            if link == joint:
                break
            link = self.parent[link]
        return total


@dataclass(frozen=True)
class _Felt:
    """What a sensor felt, in axes of the base (g, 3): w, a and their rates; `place` where it was,
    `axes` (g, 3, 3) its own."""

    w: Array
    a: Array
    w_rate: Array
    a_rate: Array
    place: Array
    axes: Array

    @classmethod
    def of(cls, fit: ImuFit, arm: _Arm, at: Estimate, k: int) -> _Felt:
        t_s, i = fit.windows.t_s + at.late_s[k], fit.links[k]
        axes = arm.R[:, i] @ at.turn[k]
        told, rate = fit._sensors[k].at(t_s), fit._sensors[k].rate(t_s)
        bias = np.r_[at.w_bias[k], at.a_bias[k]]
        told = np.concatenate([told - bias, rate], axis=1).reshape(len(t_s), 4, 3)
        w, a, w_rate, a_rate = np.moveaxis(told @ np.swapaxes(axes, 1, 2), 1, 0)
        return cls(w, a, w_rate, a_rate, arm.p[:, i] + arm.R[:, i] @ at.place[k], axes)


def _turned(x: Array, axes: Array) -> Array:
    """(g, 3, 3) slopes of a vector (g, 3) turned by small angles about axes (g, 3, 3)."""
    out, (u, v, w) = np.empty_like(axes), x.T[:, :, None]
    a, b, c = (axes[:, k] for k in range(3))
    out[:, 0], out[:, 1], out[:, 2] = w * b - v * c, u * c - w * a, v * a - u * b
    return out


def base_gauge(tree: Tree, gravity: Array, at: Estimate) -> Array:
    """(6 n, 2 roots) steps of frames that no sensor feels, where links hang on the base.

    Such a link may be turned about gravity, or slid along its axis, with all that it carries. What
    that turns and slides a frame along its own axis is undone, and passed on to the next links.
    """
    found = []
    for root in (j for j, i in enumerate(tree.parent) if i == BASE):
        for turns in (True, False):
            step, on = np.zeros((tree.n, 6)), np.zeros((tree.n, 2, 3))
            if turns:
                turn = at.R0[root].T @ gravity / np.linalg.norm(gravity)
                step[root, :2], on[root, 0, 2] = turn[:2], turn[2]
            else:
                on[root, 1, 2] = 1.0
            for j, i in enumerate(tree.parent):
                if i == BASE or not on[i].any():
                    continue
                turn, axis = at.R0[j].T @ on[i, 0], at.R0[j, :, 2]
                shift = np.cross(on[i, 0], at.p[j]) + on[i, 1]
                on[j, :, 2] = turn[2], axis @ shift
                step[j, :2], step[j, 3:] = turn[:2], shift - (axis @ shift) * axis
            found.append(step.ravel())
    return np.array(found).T


def told_apart(tree: Tree, gravity: Array, at: Estimate) -> list[Array]:
    """(6, k) orthonormal steps of each frame, [turn; shift], that are no gauge."""
    gauge = base_gauge(tree, gravity, at)
    gauge = (gauge / np.abs(gauge).max(axis=0)).reshape(tree.n, 6, -1)
    found = []
    for j in range(tree.n):
        hidden = np.zeros((6, 2))
        hidden[2, 0], hidden[3:, 1] = 1.0, at.R0[j, :, 2]
        mainly = gauge[j][:, np.linalg.norm(gauge[j], axis=0) > 0.3]  # a step moves it so far
        whole, _ = np.linalg.qr(np.concatenate([hidden, mainly], axis=1), mode="complete")
        found.append(whole[:, 2 + mainly.shape[1] :])
    return found
