"""Axes without angles, and the angular velocities at the start that follow from them.

If joint s with axis u (in frame j) moves link j on body i, where the axis is u', then at every
instant dq_s = u·w_j - u'·w_i and ddq_s = u·dw_j - u'·dw_i. That is one linear regression with six
unknowns for each pair of bodies, the same for all joints. Its misfit is a lower bound on that of
the whole relation, and its u is where the search for the whole relation starts.

Where only angular accelerations were recorded, w_j(t) = w_j(0) + ∫ dw_j in the link's frame: three
unknown numbers for each link. The axis u of a joint follows without them. Given u, the relation of
dw is linear in R0ᵀ taken as any matrix X and in w_j(0):

    exp([u] q)ᵀ X dw_i + dq w_j(0) × u = dw_j - ddq u - dq (∫ dw_j) × u

Its misfit picks the pairs that are joined. Each of them then says, linear in both ends,

    exp([u] q) (w_j - dq u) = X w_i

and all pairs together give all w(0) by least squares, in which a pair counts by what it leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from adapter.discovery.bodies import NO_JOINT, Bodies, bodies_of
from adapter.discovery.frames import best_rotation
from adapter.discovery.prepare import PreparedLog
from adapter.model.spatial import Array, exp_rotation, skew

PAIRS = 4  # pairs of each link that are looked at, by the misfit of their axis
NEAR_BEST = 4.0  # a pair is used whose misfit is below so many times the link's best one
ROUNDS = 4  # of weighting
WEAK = 1e-6  # rad/s: pull to zero of what nothing shows, in standard deviations of a sample
LEAST_RATE = 1e-4  # rad/s; no pair is trusted to be known better
SPEEDS = {"w": "dq", "dw": "ddq"}


class Axes(NamedTuple):
    """What the regression finds; the first index is the joint, then the link, then the body.

    Attributes:
        axis: (joints, links, bodies, 3) u in the link's frame, not normed.
        misfit: for each angular channel (joints, links, bodies) mean square of what is left.
    """

    axis: Array
    misfit: dict[str, Array]


def axes_of(bodies: Bodies, variance: dict[str, Array]) -> Axes:
    """Axes for every joint and pair of bodies.

    Args:
        bodies: links and the unseen base.
        variance: (links, joints, bodies) by channel; its median weighs the channels.
    """
    (m, n), links, count = bodies.log.q.shape, bodies.links, bodies.count
    first, second = np.divmod(np.arange(links * count), count)
    normal = np.tile(np.eye(6), (links * count, 1, 1))  # u and u' are about one long
    right = np.zeros((links * count, 6, n))
    parts: dict[str, tuple[Array, Array, Array]] = {}
    for k in (k for k in SPEEDS if k in bodies.channels):
        x, speed = bodies.motion[k].reshape(m, -1), getattr(bodies.log, SPEEDS[k])
        gram = (x.T @ x).reshape(count, 3, count, 3).transpose(0, 2, 1, 3)
        with_speed = (x.T @ speed).reshape(count, 3, n)
        block = np.empty((links * count, 6, 6))
        block[:, :3, :3], block[:, :3, 3:] = gram[first, first], -gram[first, second]
        block[:, 3:, :3], block[:, 3:, 3:] = -gram[second, first], gram[second, second]
        b = np.concatenate([with_speed[first], -with_speed[second]], axis=1)
        weight = 1.0 / (np.median(variance[k]) + 1e-30)
        normal += weight * block
        right += weight * b
        parts[k] = block, b, np.sum(speed**2, axis=0)
    found = np.linalg.solve(normal, right)
    misfit = {}
    for k, (block, b, power) in parts.items():
        left = power - 2.0 * np.sum(found * b, axis=1) + np.sum(found * (block @ found), axis=1)
        misfit[k] = np.maximum(left, 0.0).T.reshape(n, links, count) / m
    axis = found[:, :3].transpose(2, 0, 1).reshape(n, links, count, 3)
    return Axes(np.asarray(axis), misfit)


@dataclass(frozen=True)
class _Joined:
    """A pair: link j on body i by a joint or rigidly, exp([u] q) (m, 3, 3), X, dq u (m, 3)."""

    link: int
    body: int
    turn: Array
    x: Array
    own: Array
    misfit: float


def with_start(log: PreparedLog, base: int | None) -> PreparedLog:
    """The log with w(0) found and added; unchanged where no link is adrift."""
    if not log.adrift.any():
        return log
    bodies = bodies_of(log, base)
    adrift = np.flatnonzero(log.adrift & ~bodies.at_rest)
    joined = _pairs(replace(bodies, log=replace(log, measured=("dw",))))
    w = log.motion["w"].copy()
    w[:, adrift] += _solve(bodies, joined, adrift)
    return replace(log, motion={**log.motion, "w": w})


def _pairs(bodies: Bodies) -> list[_Joined]:
    """Of each link the pairs that explain it about as well as the best one."""
    n = len(bodies.resting)
    joints = np.append(np.arange(n), NO_JOINT)
    axes = axes_of(bodies, {"dw": bodies.variance("dw", joints)})
    misfit = axes.misfit["dw"].copy()
    misfit[bodies.resting] = np.inf
    misfit[:, np.arange(bodies.links), np.arange(bodies.links)] = np.inf
    out = []
    for j in np.flatnonzero(~bodies.at_rest).tolist():
        order = np.argsort(misfit[:, j], axis=None)[:PAIRS]
        where = zip(*np.unravel_index(order, misfit[:, j].shape), strict=True)
        found = [_moved(bodies, j, int(i), int(s), axes.axis[s, j, i]) for s, i in where]
        if bodies.resting.any() or bodies.links > n + 1:
            found += [_rigid(bodies, j, i) for i in range(bodies.count) if i != j]
        best = min(pair.misfit for pair in found)
        out += [pair for pair in found if pair.misfit <= NEAR_BEST * best]
    return out


def _moved(bodies: Bodies, link: int, body: int, joint: int, axis: Array) -> _Joined:
    m, log = len(bodies.log.q), bodies.log
    u = axis / max(float(np.linalg.norm(axis)), 1e-12)
    dq, ddq = log.dq[:, joint, None], log.ddq[:, joint, None]
    turn = exp_rotation(log.q[:, joint, None] * u)
    w, dw = bodies.motion["w"][:, link], bodies.motion["dw"][:, link]
    far = bodies.motion["dw"][:, body]
    columns = np.concatenate(
        [np.einsum("mba,mc->mabc", turn, far).reshape(m, 3, 9), -dq[:, :, None] * skew(u)], axis=2
    ).reshape(3 * m, 12)
    right = (dw - ddq * u - dq * np.cross(w, u)).reshape(-1)
    found, *_ = np.linalg.lstsq(columns, right, rcond=1e-9)
    left = right - columns @ found
    y = np.einsum("mab,mb->ma", turn, dw - ddq * u - dq * np.cross(w + found[9:], u))
    x, _ = best_rotation(y.T @ far)
    return _Joined(link, body, turn, x, dq * u, float(np.mean(left**2)))


def _rigid(bodies: Bodies, link: int, body: int) -> _Joined:
    dw, far = bodies.motion["dw"][:, link], bodies.motion["dw"][:, body]
    x, _ = best_rotation(dw.T @ far)
    turn = np.tile(np.eye(3), (len(dw), 1, 1))
    return _Joined(link, body, turn, x, np.zeros_like(dw), float(np.mean((dw - far @ x.T) ** 2)))


def _solve(bodies: Bodies, joined: list[_Joined], adrift: np.ndarray) -> Array:
    """w(0) (adrift, 3)."""
    column = {int(link): 3 * k for k, link in enumerate(adrift)}
    size = 3 * len(adrift)
    m = len(bodies.log.q)
    systems = []
    for pair in joined:
        a = np.zeros((m, 3, size))
        if pair.link in column:
            a[:, :, column[pair.link] : column[pair.link] + 3] += pair.turn
        if pair.body in column:
            a[:, :, column[pair.body] : column[pair.body] + 3] -= pair.x
        own, far = bodies.motion["w"][:, pair.link] - pair.own, bodies.motion["w"][:, pair.body]
        b = far @ pair.x.T - np.einsum("mab,mb->ma", pair.turn, own)
        flat = a.reshape(-1, size)
        systems.append((flat.T @ flat / m, flat.T @ b.reshape(-1) / m, float(np.sum(b**2)) / m))
    weight = np.ones(len(systems))
    start = np.zeros(size)
    for _ in range(ROUNDS):
        h = WEAK**2 * np.eye(size) + sum(w * s[0] for w, s in zip(weight, systems, strict=True))
        g = np.sum([w * s[1] for w, s in zip(weight, systems, strict=True)], axis=0)
        start = np.linalg.solve(h, g)
        left = np.array([c - 2 * start @ g + start @ h @ start for h, g, c in systems])
        weight = 1.0 / (np.maximum(left, 0.0) + LEAST_RATE**2)
        weight /= weight.max()
    return start.reshape(-1, 3)
