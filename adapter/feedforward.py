"""Torque that a model says a motion takes: gravity compensation and inverse dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from adapter.effects.active import Active, lasting_effects
from adapter.effects.base import smooth_sign
from adapter.effects.bodies import with_bodies
from adapter.effects.by_joint import ByJoint, to_links
from adapter.effects.catalogue import effects_by_name
from adapter.errors import SettingsError
from adapter.model import SelfModel
from adapter.records import Array
from adapter.rigid_arm import rigid_torque, wrench_torques
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
    """Inverse dynamics of a fixed-base model, compiled; some 7 µs a call for 7 joints.

    What a model's effects do to a motion is computed from one instant: the links follow the
    encoders without the rates of a gear's twist (`joint_elasticity`), a gear with `backlash`
    leans on the flank that pushes it, and `signal_delay` and `friction_drift`, which need time,
    are left out. `torque.ModelTorque` does all of it over tables.

    Args:
        tree: N and A.
        gravity: (3,) m/s² in base axes.
        lam: (n, 6) λ.
        theta: (n, 10) θ of arm and tool.
        effect_names: effects beside θ with one parameter per joint, from the catalogue.
        effect_values: (e, n) their parameters.
        known: further effects; those of bodies must be in θ and gravity (`with_bodies`).
    """

    def __init__(
        self,
        tree: Tree,
        gravity: Array,
        lam: Array,
        theta: Array,
        effect_names: Sequence[str] = (),
        effect_values: Array | None = None,
        *,
        known: Sequence[Active] = (),
    ) -> None:
        if tree.floating:
            raise SettingsError("feed-forward needs a fixed base; this model's base floats")
        n = tree.n
        self._parent = np.array(tree.parent, dtype=np.int64)
        self._base = base_motion(gravity)
        self._effects = effects_by_name(effect_names)
        self._known = ByJoint.of(known, n) if known else None
        # position, velocity, acceleration, torque: a table of one instant each
        self._signals, self._still = np.zeros((4, 1, n)), np.zeros(n)
        values = np.zeros((len(self._effects), n)) if effect_values is None else effect_values
        self.set(lam, theta, values)
        self(*np.zeros((3, n)))  # compiled now, not in the first tick

    @classmethod
    def of(cls, model: SelfModel) -> ModelFeedforward:
        """Of a model as it stands, with its tool and its effects that have no end."""
        model = with_bodies(model)
        known = lasting_effects(model.effects, model.tree.n)
        return cls(model.tree, model.gravity, model.lam, model.theta_with_tool(), known=known)

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
        signals, known = self._signals, self._known
        signals[0, 0], signals[1, 0], signals[2, 0] = q, dq, ddq
        if known is not None and known.moves:
            self._to_links(known)
        tau = self._rigid()
        if known is not None:
            link, speed, pull = signals[0, 0], signals[1, 0], signals[2, 0]
            total = tau + known.torque(link, speed, pull, tau)
            if known.pushed:
                twist = np.zeros((1, len(tau)))
                wrench_torques(self._parent, self._R0, self._p, signals[0], known.wrench, twist)
                total = total - twist[0]
            tau = total + known.gain * total
        for effect, value in zip(self._effects, self._values, strict=True):
            tau = tau + value * effect.column(q, dq, ddq)
        return tau

    def _rigid(self) -> Array:
        q, dq, ddq, tau = self._signals
        rigid_torque(self._parent, self._R0, self._p, self._base, self._theta, q, dq, ddq, tau)
        return tau[0].copy()

    def _to_links(self, known: ByJoint) -> None:
        """Put the links' motion in place of what the encoders say."""
        (q,), (dq,), (ddq,), (tau,) = self._signals
        lag = known.half_play * smooth_sign(dq)
        if known.compliance.any():
            self._rigid()
        still = self._still
        own = known.offset, known.ripple, known.phase, known.compliance
        to_links(q, dq, ddq, tau, still, still, *own)
        q -= lag
