"""How a sensor sits on its link: the axis u and a point r on it, fitted together with R0 and p.

Seen in a frame with z = u and its origin at r, a link obeys the relations of `bodies`. In the
sensor's own frame they read, with G = exp([u] q),

    w    G (w_j - dq u)                      = R0ᵀ w_i
    dw   G (dw_j - ddq u - dq w_j × u)       = R0ᵀ dw_i
    v    G (v_j + w_j × r)                   = R0ᵀ (v_i + w_i × p)
    a    G (a_j + (dw_j × + w_j × w_j ×) r)  = R0ᵀ (a_i + (dw_i × + w_i × w_i ×) p)

where p leads from the parent's sensor to the point r. They are the same seen from either side:
with i and j, r and p, R0 and R0ᵀ exchanged, u becomes -R0 u. So such a fit belongs to a pair.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from adapter.discovery.bodies import Bodies, lever
from adapter.discovery.placement import PRIOR_M, PRIOR_RAD, ROUNDS, SETTLED, STARTS, best_rotation
from adapter.spatial import Array, exp_rotation, skew, z_to_axis

FLAT = 0.05  # singular values smaller than this share leave the rotation open
LEAST_AXIS = 1e-6  # length below which the regression found no axis


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


class Mounted(NamedTuple):
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


def mount(
    bodies: Bodies, pair: tuple[int, int], joint: int, axis: Array, variance: dict[str, float]
) -> Mounted:
    """Fit u, r, R0 and p of link j = pair[0] on body i = pair[1] to all channels.

    Args:
        axis: (3,) u to start from, of any length.
        variance: of one component by channel; weighs them.
    """
    problem = _Problem(bodies, pair, joint, variance)
    length = float(np.linalg.norm(axis))
    start = axis / length if length > LEAST_AXIS else np.array([0.0, 0.0, 1.0])
    fits = [problem.descend(_State(start, x)) for x in problem.rotations(start)]
    best = min(fits, key=lambda fit: fit[1])
    state, _, misfit = best
    u, r = state.axis, state.r
    back, p = -(state.x.T @ u), state.p
    return Mounted(Mounting(u, r - (r @ u) * u), Mounting(back, p - (p @ back) * back), misfit)


class _State:
    """u, X = R0ᵀ, p and r."""

    def __init__(self, axis: Array, x: Array, places: Array | None = None) -> None:
        self.axis, self.x = axis, x
        self.places = np.zeros(6) if places is None else places  # p, r
        self.p, self.r = self.places[:3], self.places[3:]

    def stepped(self, step: Array) -> _State:
        """After a step (11,): a turn of X, a turn of u about two axes normal to it, p, r."""
        axis = exp_rotation(_normals(self.axis) @ step[3:5]) @ self.axis
        x = exp_rotation(step[:3]) @ self.x
        return _State(axis / np.linalg.norm(axis), x, self.places + step[5:])


class _Problem:
    """Least squares of one hypothesis."""

    def __init__(
        self, bodies: Bodies, pair: tuple[int, int], joint: int, variance: dict[str, float]
    ) -> None:
        link, body = pair
        recorded = bodies.recorded
        q = recorded.q[:, joint]
        self._dq, self._ddq = recorded.dq[:, joint, None], recorded.ddq[:, joint, None]
        self._c, self._s = np.cos(q)[:, None], np.sin(q)[:, None]
        self._own = {k: bodies.motion[k][:, link] for k in bodies.motion}
        self._z = {k: bodies.motion[k][:, body] for k in bodies.channels}
        self._weight = {k: 1.0 / max(variance[k], 1e-30) for k in bodies.channels}
        linear = [k for k in bodies.channels if k in ("v", "a")]
        self._arm = {k: lever(bodies.motion, k, link) for k in linear}
        self._far = {k: lever(bodies.motion, k, body) for k in linear}
        self._prior = np.repeat([PRIOR_RAD**-2, PRIOR_M**-2], [5, 6])

    def rotations(self, axis: Array) -> list[Array]:
        """X to start from: the best for the channels that need no place, or all there are."""
        state = _State(axis, np.eye(3))
        y = {k: self._turned(axis, self._inner(k, state)) for k in self._z}
        for names in ([k for k in y if k in ("w", "dw")], list(y)):
            c = np.sum([self._weight[k] * y[k].T @ self._z[k] for k in names], axis=0)
            x, values = best_rotation(c)
            if names and values[1] > FLAT * max(values[0], 1e-300):
                return [x]
        about = np.linalg.svd(c)[0][:, 0]
        turns = 2 * np.pi * np.arange(STARTS) / STARTS
        return [np.asarray(exp_rotation(about * angle) @ x) for angle in turns]

    def descend(self, state: _State) -> tuple[_State, float, dict[str, float]]:
        """Gauss-Newton, shortened where it would climb; places first, which are linear."""
        cost, g, h, misfit = self._look(state)
        places = np.zeros(11)
        places[5:] = np.linalg.solve(h[5:, 5:] + np.diag(self._prior[5:]), -g[5:])
        state = state.stepped(places)
        cost, g, h, misfit = self._look(state)
        for _ in range(ROUNDS):
            pull = np.concatenate([np.zeros(5), self._prior[5:] * state.places])
            step = np.linalg.solve(h + np.diag(self._prior), -g - pull)
            for share in (1.0, 0.25, 0.05):
                near = state.stepped(share * step)
                found = self._look(near)
                if found[0] <= cost:
                    break
            else:
                break
            gained = cost - found[0]
            state, (cost, g, h, misfit) = near, found
            if gained < SETTLED:
                break
        return state, cost, misfit

    def _turned(self, axis: Array, x: Array) -> Array:
        """exp([u] q) x."""
        along = (x @ axis)[:, None] * axis
        return np.asarray(along + self._c * (x - along) + self._s * np.cross(axis, x))

    def _inner(self, channel: str, state: _State) -> Array:
        """What G is multiplied with."""
        x, u = self._own[channel], state.axis
        if channel == "w":
            return np.asarray(x - self._dq * u)
        if channel == "dw":
            return np.asarray(x - self._ddq * u - self._dq * np.cross(self._own["w"], u))
        return np.asarray(x + self._arm[channel] @ state.r)

    def _look(self, state: _State) -> tuple[float, Array, Array, dict[str, float]]:
        """Cost, gradient, curvature, mean squares by channel."""
        u, x, m = state.axis, state.x, len(self._dq)
        turn = _times(self._c, self._s, u)  # (m, 3, 3)
        normals = _normals(u)
        cost = float(self._prior[5:] @ state.places**2)
        g, h, misfit = np.zeros(11), np.zeros((11, 11)), {}
        for k in self._z:
            inner = self._inner(k, state)
            y = np.einsum("mab,mb->ma", turn, inner)
            z = self._z[k] + self._far[k] @ state.p if k in self._far else self._z[k]
            there = z @ x.T
            left = y - there
            columns = np.zeros((m, 3, 11))
            columns[:, :, :3] = skew(there)
            for b, normal in enumerate(normals.T):
                bent = np.cross(inner if k in self._far else self._own[k], normal)
                if k == "dw":
                    bent += self._dq * np.cross(u, np.cross(self._own["w"], normal))
                columns[:, :, 3 + b] = np.einsum("mab,mb->ma", turn, bent) - np.cross(y, normal)
            if k in self._far:
                columns[:, :, 5:8] = -(x @ self._far[k])
                columns[:, :, 8:] = turn @ self._arm[k]
            flat = columns.reshape(-1, 11)
            misfit[k] = float(np.mean(left**2))
            cost += self._weight[k] * float(np.sum(left**2))
            h += self._weight[k] * flat.T @ flat
            g += self._weight[k] * flat.T @ left.reshape(-1)
        return cost, g, h, misfit


def _times(c: Array, s: Array, u: Array) -> Array:
    """exp([u] q) (m, 3, 3) from cos q and sin q (m, 1)."""
    c, s = c[:, :, None], s[:, :, None]
    along = np.outer(u, u)
    return np.asarray(along + c * (np.eye(3) - along) + s * skew(u))


def _normals(u: Array) -> Array:
    """(3, 2) unit vectors normal to u."""
    return np.asarray(z_to_axis(u)[:, :2])
