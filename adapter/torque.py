"""Torque of a self model over tables of motion, by the compiled kernels."""

from __future__ import annotations

import numpy as np

from adapter.effects import CATALOGUE
from adapter.fast import jit, link_motion, regressor
from adapter.model import SelfModel
from adapter.records import Array
from adapter.spatial import matrix_from_zxz
from adapter.twist import base_motion


@jit
def rigid_torque(parent, R0, p, base, theta, q, dq, ddq, tau):
    """tau (m, n) = Y theta over tables q, dq, ddq (m, n)."""
    n = parent.shape[0]
    motion, Y = np.empty((n, 12)), np.empty((n, 10 * n))
    for m in range(q.shape[0]):
        link_motion(parent, R0, p, q[m], dq[m], ddq[m], base, motion)
        regressor(parent, R0, p, q[m], motion, Y)
        for j in range(n):
            t = 0.0
            for k in range(10 * n):
                t += Y[j, k] * theta[k]
            tau[m, j] = t


class ModelTorque:
    """Inverse dynamics of a fixed-base self model with its tool and its effects.

    Args:
        model: whose λ, θ, tool, gravity and effects (those of the catalogue) are used.
    """

    def __init__(self, model: SelfModel) -> None:
        n = model.tree.n
        self._parent = np.array(model.tree.parent, dtype=np.int64)
        self._R0 = np.ascontiguousarray(matrix_from_zxz(model.lam[:, :3]))
        self._p = np.ascontiguousarray(model.lam[:, 3:])
        self._base = base_motion(model.gravity)
        self._theta = np.ascontiguousarray(model.theta_with_tool()[-n:]).ravel()
        self._effects = []
        for entry in model.effects:
            effect = CATALOGUE.get(entry["effect"])
            if effect is not None:
                gain = np.zeros(n)
                gain[np.array(entry["joints"]) - 1] = entry["parameters"][effect.key]
                self._effects.append((effect(), gain))

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """tau (m, n), N m, for q, dq, ddq (m, n) rad, rad/s, rad/s²."""
        tau = np.empty_like(q)
        q, dq, ddq = (np.ascontiguousarray(x) for x in (q, dq, ddq))
        frames = self._parent, self._R0, self._p, self._base
        rigid_torque(*frames, self._theta, q, dq, ddq, tau)
        for effect, gain in self._effects:
            tau += gain * effect.column(q, dq, ddq)
        return tau
