"""Torque that a model says a motion takes: gravity compensation and inverse dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from adapter import fast
from adapter.effects import effects_by_name
from adapter.errors import SettingsError
from adapter.model import SelfModel
from adapter.records import Array
from adapter.spatial import matrix_from_zxz
from adapter.tree import Tree
from adapter.twist import base_motion


class Feedforward(Protocol):
    """What a controller asks of a model.

    Attributes:
        ready: whether its torques may be used.
    """

    @property
    def ready(self) -> bool: ...

    def attach(self, name: str) -> None:
        """Follow the estimate published under this name, where the model is a learned one."""

    def detach(self) -> None:
        """Follow it no longer."""

    def refresh(self) -> None:
        """Take over what is new; called every 50 ticks or so."""

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion (n,) rad, rad/s, rad/s². Raises nothing."""


class ModelFeedforward:
    """Inverse dynamics of a fixed-base model, compiled; some 15 µs a call for 7 joints.

    Args:
        tree: N and A.
        gravity: (3,) m/s² in base axes.
        lam: (n, 6) λ.
        theta: (n, 10) θ of arm and tool.
        effect_names: effects beside θ, from the catalogue.
        effect_values: (e, n) their parameters.
    """

    def __init__(
        self,
        tree: Tree,
        gravity: Array,
        lam: Array,
        theta: Array,
        effect_names: Sequence[str] = (),
        effect_values: Array | None = None,
    ) -> None:
        if tree.floating:
            raise SettingsError("feed-forward needs a fixed base; this model's base floats")
        n = tree.n
        self._parent = np.array(tree.parent, dtype=np.int64)
        self._base = base_motion(gravity)
        self._effects = effects_by_name(effect_names)
        self._motion, self._Y = np.zeros((n, 12)), np.zeros((n, 10 * n))
        values = np.zeros((len(self._effects), n)) if effect_values is None else effect_values
        self.set(lam, theta, values)

    @classmethod
    def of(cls, model: SelfModel) -> ModelFeedforward:
        """Of a model as it stands, its tool and its effects included."""
        names = [str(e["effect"]) for e in model.effects]
        keys = [effect.key for effect in effects_by_name(names)]
        values = [e["parameters"][key] for e, key in zip(model.effects, keys, strict=True)]
        table = np.array(values, dtype=np.float64).reshape(len(names), model.tree.n)
        return cls(
            model.tree, model.gravity, model.lam, model.theta_with_tool(), tuple(names), table
        )

    @property
    def ready(self) -> bool:
        """A model is always ready."""
        return True

    def attach(self, name: str) -> None:
        """This model is not learned."""

    def detach(self) -> None:
        """Nothing to let go."""

    def refresh(self) -> None:
        """Nothing is ever new."""

    def set(self, lam: Array, theta: Array, effect_values: Array) -> None:
        """Take other parameters."""
        self._R0 = np.ascontiguousarray(matrix_from_zxz(lam[:, :3]))
        self._p = np.ascontiguousarray(lam[:, 3:])
        self._theta = np.array(theta, dtype=np.float64).reshape(-1)
        self._values = np.array(effect_values, dtype=np.float64)

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion."""
        motion, Y = self._motion, self._Y
        fast.link_motion(self._parent, self._R0, self._p, q, dq, ddq, self._base, motion)
        fast.regressor(self._parent, self._R0, self._p, q, motion, Y)
        tau: Array = Y @ self._theta
        for effect, value in zip(self._effects, self._values, strict=True):
            tau += value * effect.column(q, dq, ddq)
        return tau
