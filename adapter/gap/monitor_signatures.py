"""What a new disagreement may look like: columns of torque, sums of which the monitor fits.

Only effects that come and go while an arm is watched are here, and only those that are linear
in their parameters. What looks like one of them within two seconds is named as an ambiguity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.effects.base import smooth_sign
from adapter.fast import jit
from adapter.inertia import body_from_theta
from adapter.records import Array
from adapter.rigid_arm import regressors, wrench_torques

WRENCH_KEYS = ("fx", "fy", "fz", "mx", "my", "mz")
# Standard deviation of each coefficient where the effect is there, in its own unit.
FORCE_STD, MOMENT_STD = 12.0, 1.5  # N, N m
LOAD_STD = np.array([1.5, *[0.15] * 3, *[0.02] * 6])  # kg, kg m, kg m²
SMALLEST_MASS = 0.02  # kg; below it a load has no centre


@dataclass(frozen=True)
class Candidate:
    """One effect at one place.

    Attributes:
        name: of the catalogue; joint: from 0, -1 at the flange.
        columns: (k,) indices of its columns.
        std: (k,) of its coefficients before any data.
        log_odds: ln of how much more often than the common ones it is met.
    """

    name: str
    joint: int
    columns: np.ndarray
    std: Array
    log_odds: float

    @property
    def joints(self) -> list[int]:
        """From 1; none at the flange."""
        return [] if self.joint < 0 else [self.joint + 1]

    def decode(self, x: Array) -> dict[str, Any]:
        """Coefficients (k,) as parameters of the catalogue."""
        return _DECODE[self.name](x)


def _one(key: str) -> Callable[[Array], dict[str, Any]]:
    return lambda x: {key: float(x[0])}


def _spring(x: Array) -> dict[str, Any]:
    k = float(x[0])
    return {"k": k, "q0": float(-x[1] / k) if k else 0.0}


def _load(x: Array) -> dict[str, Any]:
    mass = float(x[0])
    found: dict[str, Any] = {"m": mass}
    if mass > SMALLEST_MASS:
        _, centre, _ = body_from_theta(x)
        found.update(zip(("cx", "cy", "cz"), map(float, centre), strict=True))
    return found


# name, typical size, log odds; the order is that of the rows in `joint_columns`
_BY_JOINT = (
    ("torque_offset", 0.5, 0.0),
    ("coulomb_friction", 0.5, 0.0),
    ("viscous_friction", 0.4, -0.5),
    ("motor_inertia", 0.15, -2.0),
    ("torque_gain", 0.07, -0.5),
    ("joint_spring", 1.0, -1.5),
)
_DECODE: dict[str, Callable[[Array], dict[str, Any]]] = {
    "torque_offset": _one("o"),
    "coulomb_friction": _one("Fc"),
    "viscous_friction": _one("Fv"),
    "motor_inertia": _one("B"),
    "torque_gain": _one("g"),
    "joint_spring": _spring,
    "payload": _load,
    "external_wrench": lambda x: dict(zip(WRENCH_KEYS, map(float, x), strict=True)),
}


def candidates(n: int) -> tuple[Candidate, ...]:
    """All of them for an arm of n joints, in the order of the columns of `columns_of`."""
    found = []
    for row, (name, size, odds) in enumerate(_BY_JOINT):
        for j in range(n):
            columns, std = [row * n + j], [size]
            if name == "joint_spring":
                columns, std = [row * n + j, j], [size, size]
            found.append(Candidate(name, j, np.array(columns), np.array(std), odds))
    at = len(_BY_JOINT) * n
    found.append(Candidate("payload", -1, np.arange(at, at + 10), LOAD_STD, 0.0))
    force = np.array([FORCE_STD] * 3 + [MOMENT_STD] * 3)
    found.append(Candidate("external_wrench", -1, np.arange(at + 10, at + 16), force, 0.0))
    return tuple(found)


@jit
def unit_wrenches(parent, R0, p, q, out):
    """out (m, n, 6) = -J^T of a wrench [f; m], base axes, at the last link's origin."""
    wrench = np.zeros(6)
    work = np.zeros(q.shape)
    for k in range(6):
        wrench[:] = 0.0
        wrench[k] = -1.0
        work[:] = 0.0
        wrench_torques(parent, R0, p, q, wrench, work)
        for m in range(q.shape[0]):
            for j in range(q.shape[1]):
                out[m, j, k] = work[m, j]


class Frames:
    """The learned frames, and all columns of torque on them.

    Args:
        parent: (n,) indices of the parents; R0, p: placements, copied.
        base: (12,) motion of the base.
        smoothing_s: how long the filter takes a step of torque.
    """

    def __init__(
        self, parent: Sequence[int], R0: Array, p: Array, base: Array, smoothing_s: float
    ) -> None:
        self.n = len(parent)
        self._parent = np.array(parent, dtype=np.int64)
        self.R0, self.p, self._base = R0.copy(), p.copy(), base
        self._smoothing_s = smoothing_s

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y (m, n, 10 n)."""
        Y = np.empty((*q.shape, 10 * self.n))
        regressors(self._parent, self.R0, self.p, self._base, q, dq, ddq, Y)
        return Y

    def signatures(self, q: Array, dq: Array, ddq: Array, tau: Array, Y: Array) -> Array:
        """(m, n, K) torque per unit of each coefficient; tau (m, n) is the model's, Y its own."""
        n = self.n
        ones = np.ones_like(q)
        sign = smooth_sign(dq, ddq, self._smoothing_s)
        out = np.zeros((*q.shape, len(_BY_JOINT) * n + 16))
        joints = np.arange(n)
        for row, column in enumerate((ones, sign, dq, ddq, tau, q)):
            out[:, joints, row * n + joints] = column
        out[:, :, -16:-6] = Y[:, :, -10:]
        unit_wrenches(self._parent, self.R0, self.p, q, out[:, :, -6:])
        return out
