"""Least squares over bodies that can exist: a semidefinite program, solved by Clarabel.

A body can exist where its pseudo-inertia (4, 4), linear in θ, is positive definite (Wensing, Kim
and Slotine 2018). The problem is convex, so there is one answer and no start to choose. Where the
data can be explained to the last bit, one of the explanations is a robot: it is looked for among
the explanations alone, as the one furthest from impossible, so that no digit is lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import clarabel
import numpy as np
from scipy import sparse

from adapter.errors import ModelError
from adapter.inertia import min_eigenvalue, pseudo_inertia
from adapter.offline.theta_factors import PER_BODY
from adapter.spatial import Array

LENGTH = 0.1  # m, in units of which the entries of a link's pseudo-inertia (kg) are of like size
EDGE = 1e-6  # kg, least eigenvalue in those units of a body that noise pushes to the edge
ROOM = 1e-2  # kg, such an eigenvalue from which on more room is worth nothing
LIGHT = 1e-6  # kg of room that 1 kg of mass (and of its size) is worth: what is unseen stays light
HELD = 1e-9  # weight of a body of 1 kg and radius `LENGTH`, to the mean weight of the data
PRECISION = 1e-10  # of the solver, relative and absolute
SOLVED = ("Solved", "AlmostSolved")

_UPPER = [(row, column) for column in range(4) for row in range(column + 1)]


def _entries(matrix: Array) -> Array:
    """(..., 10) of symmetric matrices (..., 4, 4): as Clarabel wants a triangle."""
    twice = np.sqrt(2.0)
    parts = [matrix[..., i, j] * (1.0 if i == j else twice) for i, j in _UPPER]
    return np.stack(parts, axis=-1)


_UNITS = np.diag([1.0 / LENGTH] * 3 + [1.0])
_FROM_THETA = _entries(_UNITS @ pseudo_inertia(np.eye(PER_BODY)) @ _UNITS).T  # entries of one body
_TO_THETA = np.linalg.inv(_FROM_THETA)
_ONE = _entries(np.eye(4))  # a body of 1 kg whose radius about its origin is `LENGTH` each way


@dataclass(frozen=True)
class Possible:
    """What was found.

    Attributes:
        theta: (bodies, 10), every body possible.
        steps: of the solver.
        solved: whether nothing better is possible; else it is the best found.
    """

    theta: Array
    steps: int
    solved: bool


def possible_theta(r: Array, b: Array, shown: Array, hidden: Array) -> Possible:
    """The possible bodies that leave least of R θ = b, and what does not show near a small body.

    Args:
        r: (k, 10 bodies); b: (k,).
        shown: (10 bodies,) a least-squares solution.
        hidden: (10 bodies, h) directions of θ that R does not show.

    Raises:
        ModelError: the solver gave up without an answer.
    """
    exact = _roomiest(shown.reshape(-1, PER_BODY), hidden)
    if exact.solved:
        return exact
    found = _closest(r, b)
    return replace(found, steps=exact.steps + found.steps)


def _roomiest(shown: Array, hidden: Array) -> Possible:
    """Among all least-squares solutions the one whose bodies are furthest from impossible.

    Maximised is the least eigenvalue t of all bodies, up to `ROOM`; solved if it is above zero.
    """
    bodies, count = len(shown), hidden.shape[1]
    fixed = (shown @ _FROM_THETA.T).ravel()
    moved = np.einsum("ek,bkh->beh", _FROM_THETA, hidden.reshape(bodies, PER_BODY, count))
    free = np.linalg.qr(moved.reshape(PER_BODY * bodies, count))[0]
    one = np.tile(_ONE, bodies)
    size = max(float(np.abs(fixed).max()), 1e-300)
    goal = np.append(LIGHT * (free.T @ one), -1.0)
    in_cone = np.column_stack([-free, one])
    in_room = np.append(np.zeros(count), 1.0)
    cones = [*_cones(bodies), clarabel.NonnegativeConeT(1)]
    x, steps, _ = _solve(
        np.zeros((count + 1, count + 1)),
        goal,
        np.vstack([in_cone, in_room]),
        np.append(fixed, ROOM) / size,
        cones,
    )
    if not np.isfinite(x).all():
        return Possible(shown, steps, False)
    theta = (fixed + size * (free @ x[:count])).reshape(bodies, PER_BODY) @ _TO_THETA.T
    return Possible(theta, steps, bool(min_eigenvalue(theta).min() > 0.0))


def _closest(r: Array, b: Array) -> Possible:
    """Least squares with every eigenvalue at least `EDGE`."""
    bodies = r.shape[1] // PER_BODY
    table = np.einsum("kbe,ef->kbf", r.reshape(len(r), bodies, PER_BODY), _TO_THETA)
    table = table.reshape(len(r), -1)
    power = float(b @ b) or 1.0
    quadratic, goal = table.T @ table / power, -(table.T @ b) / power
    hold = HELD * float(np.trace(quadratic)) / len(quadratic)
    one = np.tile(_ONE, bodies)
    x, steps, solved = _solve(
        quadratic + hold * np.eye(len(quadratic)),
        goal - hold * one,
        -np.eye(len(quadratic)),
        -EDGE * one,
        _cones(bodies),
    )
    if not np.isfinite(x).all():
        raise ModelError("no possible bodies were found near what the data say; are they sound?")
    theta = x.reshape(bodies, PER_BODY) @ _TO_THETA.T
    least = np.linalg.eigvalsh(_UNITS @ pseudo_inertia(theta) @ _UNITS).min(axis=-1)
    # where the solver stopped short of the edge's right side
    lifted = np.maximum(EDGE - least, 0.0)[:, None] * (_ONE @ _TO_THETA.T)
    return Possible(theta + lifted, steps, solved)


def _cones(bodies: int) -> list[clarabel.PSDTriangleConeT]:
    return [clarabel.PSDTriangleConeT(4)] * bodies


def _solve(
    quadratic: Array, linear: Array, left: Array, right: Array, cones: list[object]
) -> tuple[Array, int, bool]:
    """Minimise x·Q x / 2 + linear·x where right - left x lies in the cones: x, steps, solved."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = PRECISION
    # Its scaling of rows would turn the cones; the units above scale better.
    settings.equilibrate_enable = False
    upper = sparse.triu(sparse.csc_matrix(quadratic), format="csc")
    solver = clarabel.DefaultSolver(upper, linear, sparse.csc_matrix(left), right, cones, settings)
    answer = solver.solve()
    return np.array(answer.x), int(answer.iterations), str(answer.status) in SOLVED
