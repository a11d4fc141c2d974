"""The frame (R0, p) that explains a link's motion best, given its joint and its parent.

Stage 1, for every (link, joint, parent) at once: the angular channels alone, whose best rotation
has a closed form (Kabsch 1976). Its misfit is a lower bound on that of all channels. Stage 2, for
what is left: all channels, Gauss-Newton in a turn of R0 and p.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adapter.discovery.bodies import Bodies, across, lever
from adapter.spatial import Array, exp_rotation, skew

PRIOR_M = 1.0  # m, spread of p where data don't show it
PRIOR_RAD = 10.0  # rad, the same for turns: next to nothing
ROUNDS = 12  # of Gauss-Newton
SETTLED = 1e-2  # of the sum of squares in noise variances, less than which no round may gain
FLAT_SIGNAL = 1e-9  # singular values smaller than this share are rounding
FLAT = 0.05  # singular values smaller than this share leave the rotation open
STARTS = 4  # turns about the one direction that is known, where the rotation is open


class Placement(NamedTuple):
    """A fitted frame.

    Attributes:
        rotation: (3, 3) R0, frame j in the parent's at q = 0; position: (3,) p, m.
        misfit: mean square of one component of y - R0ᵀ z, by channel.
    """

    rotation: Array
    position: Array
    misfit: dict[str, float]


def best_rotation(c: Array) -> tuple[Array, Array]:
    """X (..., 3, 3) = R0ᵀ that makes tr(Xᵀ C) largest, C = Σ y zᵀ; and the singular values."""
    u, values, vt = np.linalg.svd(c)
    sign = np.sign(np.linalg.det(u @ vt))
    u[..., :, 2] *= sign[..., None]
    return u @ vt, values


def angular_misfit(bodies: Bodies, joints: np.ndarray) -> dict[str, Array]:
    """Mean squares (links, joints, bodies) of w and dw at the rotation best for both."""
    m = len(bodies.recorded.q)
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
    m = len(bodies.recorded.q)
    channels = [k for k in ("v", "a") if k in bodies.channels]
    out: dict[str, Array] = {
        k: np.empty((bodies.links, len(joints), bodies.count)) for k in channels
    }
    for k in channels:
        bases = [_orthonormal(_signals(bodies, k, i)) for i in range(bodies.count)]
        starts = np.cumsum([0, *(b.shape[1] for b in bases[:-1])])
        every = np.concatenate(bases, axis=1)
        for j in range(bodies.links):
            y = across(bodies, k, j, joints).reshape(m, -1)
            inside = np.add.reduceat((every.T @ y) ** 2, starts, axis=0)
            left = np.maximum(np.sum(y**2, axis=0) - inside, 0.0)
            out[k][j] = left.reshape(bodies.count, len(joints), 3).sum(axis=2).T / (3 * m)
    return out


def _signals(bodies: Bodies, channel: str, body: int) -> Array:
    """(m, 6) or (m, 12): all that z of v or a is linear in, for one parent."""
    x, w = bodies.motion[channel][:, body], bodies.motion["w"][:, body]
    if channel == "v":
        return np.concatenate([x, w], axis=1)
    products = w[:, [0, 0, 0, 1, 1, 2]] * w[:, [0, 1, 2, 1, 2, 2]]
    return np.concatenate([x, bodies.motion["dw"][:, body], products], axis=1)


def _orthonormal(x: Array) -> Array:
    """Orthonormal columns (m, rank) that span those of x; one zero column for x = 0."""
    u, values, _ = np.linalg.svd(x, full_matrices=False)
    kept = u[:, values > FLAT_SIGNAL * max(float(values[0]), 1e-300)]
    return kept if kept.shape[1] else np.zeros((len(x), 1))


def place(
    bodies: Bodies, link: int, joint: int, parent: int, variance: dict[str, float]
) -> Placement:
    """Fit R0 and p to all channels; `variance` of one component by channel weighs them."""
    y = {k: across(bodies, k, link, np.array([joint]))[:, 0] for k in bodies.channels}
    z = {k: bodies.motion[k][:, parent] for k in bodies.channels}
    arms: dict[str, Array] = {
        k: lever(bodies.motion, k, parent) for k in ("v", "a") if k in bodies.channels
    }
    problem = _Problem(y, z, arms, {k: 1.0 / max(variance[k], 1e-30) for k in y})
    fits = [problem.descend(start) for start in _starts(problem)]
    return min(fits, key=problem.cost_of)


def _starts(problem: _Problem) -> list[Array]:
    c = sum(problem.weight[k] * problem.y[k].T @ problem.z[k] for k in problem.y)
    x, values = best_rotation(np.asarray(c))
    if values[1] > FLAT * max(values[0], 1e-300):
        return [x]
    axis = np.linalg.svd(c)[0][:, 0]
    turns = 2 * np.pi * np.arange(STARTS) / STARTS
    return [exp_rotation(axis * angle) @ x for angle in turns]


class _Problem:
    """Least squares of one hypothesis."""

    def __init__(
        self,
        y: dict[str, Array],
        z: dict[str, Array],
        arms: dict[str, Array],
        weight: dict[str, float],
    ) -> None:
        self.y, self.z, self.arms, self.weight = y, z, arms, weight
        self._prior = np.diag(np.repeat([1.0 / PRIOR_RAD**2, 1.0 / PRIOR_M**2], 3))

    def cost_of(self, fit: Placement) -> float:
        """Weighted sum of squares."""
        m = len(next(iter(self.y.values())))
        return float(sum(3 * m * self.weight[k] * fit.misfit[k] for k in self.y))

    def descend(self, x: Array) -> Placement:
        """Gauss-Newton from X = R0ᵀ, halved where it would climb."""
        p = self._best_position(x)
        cost, gradient, curvature, misfit = self._look(x, p)
        for _ in range(ROUNDS):
            step = np.linalg.solve(curvature + self._prior, -gradient - self._prior[:, 3:] @ p)
            for share in (1.0, 0.25, 0.05):
                near = exp_rotation(share * step[:3]) @ x, p + share * step[3:]
                found = self._look(*near)
                if found[0] <= cost:
                    break
            else:
                break
            gained = cost - found[0]
            (x, p), (cost, gradient, curvature, misfit) = near, found
            if gained < SETTLED:
                break
        return Placement(x.T, p, misfit)

    def _best_position(self, x: Array) -> Array:
        h, g = self._prior[3:, 3:].copy(), np.zeros(3)
        for k, arm in self.arms.items():
            left = self.y[k] @ x - self.z[k]
            h += self.weight[k] * np.einsum("mab,mac->bc", arm, arm)
            g += self.weight[k] * np.einsum("mab,ma->b", arm, left)
        return np.asarray(np.linalg.solve(h, g))

    def _look(self, x: Array, p: Array) -> tuple[float, Array, Array, dict[str, float]]:
        """Cost, gradient, curvature in [turn of X; shift], mean squares by channel."""
        cost, g, h = float(p @ p) / PRIOR_M**2, np.zeros(6), np.zeros((6, 6))
        misfit: dict[str, float] = {}
        for k in self.y:
            z = self.z[k] + self.arms[k] @ p if k in self.arms else self.z[k]
            there = z @ x.T
            left = self.y[k] - there
            misfit[k] = float(np.mean(left**2))
            cost += self.weight[k] * float(np.sum(left**2))
            columns = np.zeros((len(z), 3, 6))
            columns[:, :, :3] = skew(there)
            if k in self.arms:
                columns[:, :, 3:] = -(x @ self.arms[k])
            flat = columns.reshape(-1, 6)
            h += self.weight[k] * flat.T @ flat
            g += self.weight[k] * flat.T @ left.reshape(-1)
        return cost, g, h, misfit
