"""The frame that explains a link's motion best, given its joint and its parent.

Where links turn about the z of their frames (eq. 9), a frame is R0 and p, and the relations are
those of `bodies`. Where a sensor sits anyhow on its link, the joint's axis u and a point r on it
belong to the fit as well. Seen in a frame with z = u and its origin at r the link obeys the same
relations; in the sensor's own frame they read, with G = exp([u] q),

    w    G (w_j - dq u)                      = R0ᵀ w_i
    dw   G (dw_j - ddq u - dq w_j × u)       = R0ᵀ dw_i
    v    G (v_j + w_j × r)                   = R0ᵀ (v_i + w_i × p)
    a    G (a_j + (dw_j × + w_j × w_j ×) r)  = R0ᵀ (a_i + (dw_i × + w_i × w_i ×) p)

where p leads from the parent's sensor to the point r. They are the same seen from either side:
with i and j, r and p, R0 and R0ᵀ exchanged, u becomes -R0 u. So such a fit belongs to a pair.

Before any fit come bounds for every (link, joint, parent) at once: of the angular channels the
best rotation has a closed form (Kabsch 1976), of the linear ones a regression without constraints
does at least as well as any frame.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from adapter.discovery.bodies import NO_JOINT, Bodies, across, lever
from adapter.model.spatial import Array, exp_rotation, skew, z_to_axis

PRIOR_M = 1.0  # m, spread of p and r where data don't show them
PRIOR_RAD = 10.0  # rad, the same for turns: next to nothing
ROUNDS = 12  # of Gauss-Newton
SHARES = (1.0, 0.25, 0.05)  # of a step, tried until one does not climb
SETTLED = 1e-2  # of the sum of squares in noise variances, less than which no round may gain
FLAT_SIGNAL = 1e-9  # singular values smaller than this share are rounding
FLAT = 0.05  # singular values smaller than this share leave the rotation open
STARTS = 4  # turns about the one direction that is known, where the rotation is open
LEAST_AXIS = 1e-6  # length below which the regression found no axis
Z_AXIS: Array = np.array([0.0, 0.0, 1.0])
FIXED = 6  # unknowns of a step where the axis is known: a turn of R0, and p
# ... and what follows where it is free: a turn of the axis about its two normals, and r
PRIOR: Array = np.repeat([PRIOR_RAD**-2, PRIOR_M**-2, PRIOR_RAD**-2, PRIOR_M**-2], [3, 3, 2, 3])


class Mounting(NamedTuple):
    """Where a joint's axis lies in the frame of the sensor of the link that it moves.

    Attributes:
        axis: (3,) u, a unit vector; origin: (3,) r, m, the point of the axis next to the sensor.
    """

    axis: Array
    origin: Array

    @property
    def rotation(self) -> Array:
        """(3, 3) the joint frame's axes in the sensor's frame: the smallest turn of z to u."""
        return z_to_axis(self.axis)

    def as_dict(self) -> dict[str, Any]:
        """The sensor in its joint's frame, for JSON: its axes (3, 3) by column, its place, m."""
        turn = self.rotation.T
        return {"rotation": turn.tolist(), "position": (-turn @ self.origin).tolist()}


class PairFit(NamedTuple):
    """A fit of a pair: of link j on body i.

    Attributes:
        child: axis and its place in frame j.
        parent: the same of the reversed pair, in frame i.
        misfit: mean square of one component, by channel.
    """

    child: Mounting
    parent: Mounting
    misfit: dict[str, float]


def in_joint_frame(motion: dict[str, Array], link: int, mounting: Mounting) -> dict[str, Array]:
    """One link's motion (m, 3) by channel, moved from its sensor's frame to its joint's."""
    turn = mounting.rotation
    out = {}
    for k, x in motion.items():
        own = x[:, link]
        if k in ("v", "a"):
            own = own + lever(motion, k, link) @ mounting.origin
        out[k] = own @ turn
    return out


# --- bounds, for all hypotheses at once --------------------------------------------------------


def best_rotation(c: Array) -> tuple[Array, Array]:
    """X (..., 3, 3) = R0ᵀ that makes tr(Xᵀ C) largest, C = Σ y zᵀ; and the singular values."""
    u, values, vt = np.linalg.svd(c)
    sign = np.sign(np.linalg.det(u @ vt))
    u[..., :, 2] *= sign[..., None]
    return u @ vt, values


def angular_misfit(bodies: Bodies, joints: np.ndarray) -> dict[str, Array]:
    """Mean squares (links, joints, bodies) of w and dw at the rotation best for both."""
    m = len(bodies.log.q)
    channels: list[str] = [k for k in ("w", "dw") if k in bodies.channels]
    weight = {k: 1.0 / (np.median(bodies.variance(k, joints)) + 1e-30) for k in channels}
    out: dict[str, Array] = {
        k: np.empty((bodies.links, len(joints), bodies.count)) for k in channels
    }
    z = {k: bodies.motion[k].reshape(m, -1) for k in channels}
    for j in range(bodies.links):
        c: dict[str, Array] = {}
        power: dict[str, Array] = {}
        for k in channels:
            y = across(bodies, k, j, joints)
            c[k] = (y.reshape(m, -1).T @ z[k]).reshape(len(joints), 3, bodies.count, 3)
            c[k] = c[k].transpose(0, 2, 1, 3)
            own = np.sum(bodies.motion[k] ** 2, axis=(0, 2))
            power[k] = np.sum(y**2, axis=(0, 2))[:, None] + own[None]
        x, _ = best_rotation(np.asarray(sum(weight[k] * c[k] for k in channels)))
        for k in channels:
            along = np.einsum("siab,siab->si", x, c[k])
            out[k][j] = np.maximum(power[k] - 2.0 * along, 0.0) / (3 * m)
    return out


def linear_misfit(bodies: Bodies, joints: np.ndarray) -> dict[str, Array]:
    """Mean squares (links, joints, bodies) of v and a that no frame can go below.

    y is regressed on all the signals that z is made of, with free factors instead of R0 and p.
    """
    m = len(bodies.log.q)
    channels = [k for k in ("v", "a") if k in bodies.channels]
    out: dict[str, Array] = {
        k: np.empty((bodies.links, len(joints), bodies.count)) for k in channels
    }
    for k in channels:
        bases = [_spanning(bodies, k, i) for i in range(bodies.count)]
        starts = np.cumsum([0, *(b.shape[1] for b in bases[:-1])])
        every = np.concatenate(bases, axis=1)
        for j in range(bodies.links):
            y = across(bodies, k, j, joints).reshape(m, -1)
            inside = np.add.reduceat((every.T @ y) ** 2, starts, axis=0)
            left = np.maximum(np.sum(y**2, axis=0) - inside, 0.0)
            out[k][j] = left.reshape(bodies.count, len(joints), 3).sum(axis=2).T / (3 * m)
    return out


def _spanning(bodies: Bodies, channel: str, body: int) -> Array:
    """Orthonormal columns (m, rank) that span all that z of v or a is linear in, for one parent.

    One zero column where all of that is zero.
    """
    x, w = bodies.motion[channel][:, body], bodies.motion["w"][:, body]
    parts = [x, w]
    if channel == "a":
        products = w[:, [0, 0, 0, 1, 1, 2]] * w[:, [0, 1, 2, 1, 2, 2]]
        parts = [x, bodies.motion["dw"][:, body], products]
    u, values, _ = np.linalg.svd(np.concatenate(parts, axis=1), full_matrices=False)
    kept = u[:, values > FLAT_SIGNAL * max(float(values[0]), 1e-300)]
    return kept if kept.shape[1] else np.zeros((len(x), 1))


# --- one hypothesis fitted ---------------------------------------------------------------------


def misfit_about_z(
    bodies: Bodies, pair: tuple[int, int], joint: int, variance: dict[str, float]
) -> dict[str, float]:
    """Mean square of one component, by channel, at the best R0 and p of link pair[0] on pair[1].

    Args:
        joint: index, NO_JOINT where the link rides rigidly.
        variance: of one component by channel; weighs them.
    """
    return _Problem(bodies, pair, joint, variance, free=False).best(Z_AXIS)[1].misfit


def mount(
    bodies: Bodies, pair: tuple[int, int], joint: int, axis: Array, variance: dict[str, float]
) -> PairFit:
    """Fit u, r, R0 and p of link j = pair[0] on body i = pair[1] to all channels.

    Args:
        axis: (3,) u to start from, of any length.
        variance: of one component by channel; weighs them.
    """
    length = float(np.linalg.norm(axis))
    start = axis / length if length > LEAST_AXIS else Z_AXIS
    state, look = _Problem(bodies, pair, joint, variance, free=True).best(start)
    u, r = state.axis, state.r
    back, p = -(state.x.T @ u), state.p
    child, parent = Mounting(u, r - (r @ u) * u), Mounting(back, p - (p @ back) * back)
    return PairFit(child, parent, look.misfit)


class _State(NamedTuple):
    """X = R0ᵀ, the axis u, p and r."""

    x: Array
    axis: Array
    p: Array = np.zeros(3)
    r: Array = np.zeros(3)

    def stepped(self, step: Array) -> _State:
        """After a step: a turn of X, p; where it goes on, a turn of u about its normals, r."""
        x, p = exp_rotation(step[:3]) @ self.x, self.p + step[3:6]
        if len(step) == FIXED:
            return _State(x, self.axis, p)
        axis = exp_rotation(_normals(self.axis) @ step[6:8]) @ self.axis
        return _State(x, axis / np.linalg.norm(axis), p, self.r + step[8:])

    def offset(self, size: int) -> Array:
        """What the prior pulls to zero, (size,) in the order of a step: p and r."""
        return np.concatenate([np.zeros(3), self.p, np.zeros(2), self.r])[:size]


class _Look(NamedTuple):
    """Cost with the prior's; gradient and curvature without; mean squares by channel."""

    cost: float
    gradient: Array
    curvature: Array
    misfit: dict[str, float]


class _Problem:
    """Least squares of one hypothesis; the axis is known (z) or free."""

    def __init__(
        self,
        bodies: Bodies,
        pair: tuple[int, int],
        joint: int,
        variance: dict[str, float],
        free: bool,
    ) -> None:
        (link, body), log = pair, bodies.log
        rigid = joint == NO_JOINT
        q, self._dq, self._ddq = (
            np.zeros((len(x), 1)) if rigid else x[:, joint, None] for x in (log.q, log.dq, log.ddq)
        )
        self._c, self._s = np.cos(q), np.sin(q)
        self._own = {k: bodies.motion[k][:, link] for k in bodies.motion}
        self._z = {k: bodies.motion[k][:, body] for k in bodies.channels}
        self._weight = {k: 1.0 / max(variance[k], 1e-30) for k in bodies.channels}
        linear = [k for k in bodies.channels if k in ("v", "a")]
        self._far = {k: lever(bodies.motion, k, body) for k in linear}
        self._arm = {k: lever(bodies.motion, k, link) for k in linear} if free else {}
        self._free = free
        self._prior = PRIOR if free else PRIOR[:FIXED]
        self._fixed_y = None if free else self._seen(_State(np.eye(3), Z_AXIS))

    def best(self, axis: Array) -> tuple[_State, _Look]:
        """The best of the descents from all starts, begun with an axis (3,)."""
        ends = [self._descend(start) for start in self._starts(axis)]
        return min(ends, key=lambda end: end[1].cost)

    def _starts(self, axis: Array) -> list[_State]:
        """By the channels that need no place if the axis is free and they tell; else by all."""
        y = self._seen(_State(np.eye(3), axis))
        angular = [k for k in y if k in ("w", "dw")]
        for names in [angular, list(y)] if self._free and angular else [list(y)]:
            c = np.sum([self._weight[k] * y[k].T @ self._z[k] for k in names], axis=0)
            x, values = best_rotation(c)
            if values[1] > FLAT * max(values[0], 1e-300):
                return [_State(x, axis)]
        about = np.linalg.svd(c)[0][:, 0]
        turns = 2 * np.pi * np.arange(STARTS) / STARTS
        return [_State(exp_rotation(about * angle) @ x, axis) for angle in turns]

    def _descend(self, state: _State) -> tuple[_State, _Look]:
        """Gauss-Newton, shortened where it would climb; places first, which are linear."""
        look = self._look(state)
        at = np.flatnonzero(self._prior == PRIOR_M**-2)
        step: Array = np.zeros(len(self._prior))
        curvature = look.curvature[np.ix_(at, at)] + np.diag(self._prior[at])
        step[at] = -np.linalg.solve(curvature, look.gradient[at])
        state = state.stepped(step)
        look = self._look(state)
        for _ in range(ROUNDS):
            pull = self._prior * state.offset(len(self._prior))
            curvature = look.curvature + np.diag(self._prior)
            step = np.asarray(np.linalg.solve(curvature, -look.gradient - pull))
            for share in SHARES:
                near = state.stepped(share * step)
                found = self._look(near)
                if found.cost <= look.cost:
                    break
            else:
                break
            gained = look.cost - found.cost
            state, look = near, found
            if gained < SETTLED:
                break
        return state, look

    def _inner(self, channel: str, state: _State) -> Array:
        """(m, 3) what G is multiplied with."""
        x, u = self._own[channel], state.axis
        if channel == "w":
            return np.asarray(x - self._dq * u)
        if channel == "dw":
            return np.asarray(x - self._ddq * u - self._dq * np.cross(self._own["w"], u))
        return np.asarray(x + self._arm[channel] @ state.r) if self._free else x

    def _turned(self, axis: Array, x: Array) -> Array:
        """G x (m, 3)."""
        along = (x @ axis)[:, None] * axis
        return np.asarray(along + self._c * (x - along) + self._s * np.cross(axis, x))

    def _seen(self, state: _State) -> dict[str, Array]:
        """The left sides of the relations (m, 3)."""
        return {k: self._turned(state.axis, self._inner(k, state)) for k in self._z}

    def _look(self, state: _State) -> _Look:
        size, m = len(self._prior), len(self._dq)
        y = self._seen(state) if self._fixed_y is None else self._fixed_y
        cost = float(self._prior @ state.offset(size) ** 2)
        g, h, misfit = np.zeros(size), np.zeros((size, size)), {}
        for k in self._z:
            z = self._z[k] + self._far[k] @ state.p if k in self._far else self._z[k]
            there = z @ state.x.T
            left = y[k] - there
            columns = np.zeros((m, 3, size))
            columns[:, :, :3] = skew(there)
            if k in self._far:
                columns[:, :, 3:6] = -(state.x @ self._far[k])
            if self._free:
                self._add_axis_columns(columns, k, state, y[k])
            flat = columns.reshape(-1, size)
            misfit[k] = float(np.mean(left**2))
            cost += self._weight[k] * float(np.sum(left**2))
            h += self._weight[k] * flat.T @ flat
            g += self._weight[k] * flat.T @ left.reshape(-1)
        return _Look(cost, g, h, misfit)

    def _add_axis_columns(self, columns: Array, channel: str, state: _State, y: Array) -> None:
        """Derivatives of the left side by a turn of u about its two normals, and by r."""
        u, linear = state.axis, channel in self._far
        inner = self._inner(channel, state) if linear else self._own[channel]
        for b, normal in enumerate(_normals(u).T):
            bent = np.cross(inner, normal)
            if channel == "dw":
                bent += self._dq * np.cross(u, np.cross(self._own["w"], normal))
            columns[:, :, 6 + b] = self._turned(u, bent) - np.cross(y, normal)
        if linear:
            for b in range(3):
                columns[:, :, 8 + b] = self._turned(u, self._arm[channel][:, :, b])


def _normals(u: Array) -> Array:
    """(3, 2) unit vectors normal to u."""
    return np.asarray(z_to_axis(u)[:, :2])
