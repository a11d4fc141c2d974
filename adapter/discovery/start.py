"""Angular velocities at the start, where only angular accelerations were recorded.

w_j(t) = w_j(0) + ∫ dw_j in the link's frame: three unknown numbers for each link. The axis u of a
joint follows without them (`axes`). Given u, the relation of dw is linear in R0ᵀ taken as any
matrix X and in w_j(0):

    exp([u] q)ᵀ X dw_i + dq w_j(0) × u = dw_j - ddq u - dq (∫ dw_j) × u

Its misfit picks the pairs that are joined. Each of them then says, linear in both ends,

    exp([u] q) (w_j - dq u) = X w_i

and all pairs together give all w(0) by least squares, in which a pair counts by what it leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from adapter.discovery.axes import axes_of
from adapter.discovery.bodies import NO_JOINT, Bodies, bodies_of
from adapter.discovery.placement import best_rotation
from adapter.discovery.recorded import Recorded
from adapter.spatial import Array, skew

CANDIDATES = 4  # pairs of each link that are looked at, by the misfit of their axis
NEAR_BEST = 4.0  # a pair is used whose misfit is below so many times the link's best one
ROUNDS = 4  # of weighting
WEAK = 1e-6  # rad/s: pull to zero of what nothing shows, in standard deviations of a sample
LEAST_RATE = 1e-4  # rad/s; no pair is trusted to be known better


@dataclass(frozen=True)
class _Joined:
    """A pair: link j on body i by a joint or rigidly, exp([u] q) (m, 3, 3), X, dq u (m, 3)."""

    link: int
    body: int
    turn: Array
    x: Array
    own: Array
    misfit: float


def with_start(recorded: Recorded, base: int | None) -> Recorded:
    """The recording with w(0) found and added; unchanged where no link is adrift."""
    if not recorded.adrift.any():
        return recorded
    bodies = bodies_of(recorded, base)
    adrift = np.flatnonzero(recorded.adrift & ~bodies.at_rest)
    joined = _pairs(replace(bodies, recorded=replace(recorded, measured=("dw",))))
    start = _solve(bodies, joined, adrift)
    w = recorded.motion["w"].copy()
    w[:, adrift] += start
    return replace(recorded, motion={**recorded.motion, "w": w})


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
        order = np.argsort(misfit[:, j], axis=None)[:CANDIDATES]
        where = zip(*np.unravel_index(order, misfit[:, j].shape), strict=True)
        found = [_moved(bodies, j, int(i), int(s), axes.axis[s, j, i]) for s, i in where]
        if bodies.resting.any() or bodies.links > n + 1:
            found += [_rigid(bodies, j, i) for i in range(bodies.count) if i != j]
        best = min(pair.misfit for pair in found)
        out += [pair for pair in found if pair.misfit <= NEAR_BEST * best]
    return out


def _moved(bodies: Bodies, link: int, body: int, joint: int, axis: Array) -> _Joined:
    recorded = bodies.recorded
    m = len(recorded.q)
    u = axis / max(float(np.linalg.norm(axis)), 1e-12)
    q = recorded.q[:, joint, None, None]
    dq, ddq = recorded.dq[:, joint, None], recorded.ddq[:, joint, None]
    along = np.outer(u, u)
    turn = along + np.cos(q) * (np.eye(3) - along) + np.sin(q) * skew(u)
    w, dw = bodies.motion["w"][:, link], bodies.motion["dw"][:, link]
    far = bodies.motion["dw"][:, body]
    columns = np.concatenate(
        [
            np.einsum("mba,mc->mabc", turn, far).reshape(m, 3, 9),
            -dq[:, :, None] * skew(u),
        ],
        axis=2,
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
    m = len(bodies.recorded.q)
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
