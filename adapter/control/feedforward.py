"""Torque that a model says a motion takes: gravity compensation and inverse dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from adapter.effects.active import Active, by_joint, lasting_effects, with_bodies
from adapter.effects.by_joint import WAYS_RAD, ByJoint, JointSignals, smooth_sign
from adapter.effects.catalogue import effects_by_name
from adapter.effects.link_angles import Gears, JointTorques, to_links
from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import JointMotion, base_at_rest, frames_of, torques, wrench_torques
from adapter.signals.bristles import Bristles, wind


class Feedforward(Protocol):
    """What a controller asks of a model.

    Attributes:
        ready: whether its torques may be used.
        notes: what the user should be told of it.
    """

    @property
    def ready(self) -> bool: ...

    @property
    def notes(self) -> Sequence[str]: ...

    def attach(self, name: str) -> None:
        """Follow the estimate published under this name, where the model is a learned one."""

    def detach(self) -> None:
        """Follow it no longer."""

    def refresh(self) -> None:
        """Take over what is new; called every 50 ticks or so."""

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion (n,) rad, rad/s, rad/s². Raises nothing."""

    def unbent(self, q: Array) -> Array:
        """Torques (n,) N m of holding still with nothing bent: gravity. Raises nothing."""


def not_learned(documented: SelfModel, effect_names: Sequence[str]) -> list[Active]:
    """Lasting effects of a documented model but for its bodies and for those that are learned."""
    whole = with_bodies(documented)
    lasting = lasting_effects(whole.effects, whole.tree.n)
    return [active for active in lasting if active.effect.name not in effect_names]


class ModelFeedforward:
    """Inverse dynamics of a fixed-base model, compiled; some 7 µs a call for 7 joints.

    What a model's effects do to a motion is computed from one instant: the links follow the
    encoders without the rates of a gear's twist, a gear with play leans on the flank that pushes
    it, and what needs time (a late sensor, friction that drifts) is left out. `torque.ModelTorque`
    does all of it over tables. Bristles wind up along the motions asked for, one after the other.

    Args:
        tree: N and A.
        gravity: (3,) m/s² in base axes.
        effect_names: effects beside θ with one parameter per joint, from the catalogue.
        known: further effects; those of bodies must be in θ and gravity (`with_bodies`).

    Until `set` has given it parameters its torques are zero. Asked again for the very same arrays,
    it says what it said.

    Attributes:
        frames, theta: of the rigid bodies in use; θ (n, 10) with the tool.
        gravity: (3,) m/s².
    """

    notes: Sequence[str] = ()

    def __init__(
        self,
        tree: Tree,
        gravity: Array,
        effect_names: Sequence[str] = (),
        known: Sequence[Active] = (),
    ) -> None:
        if tree.floating:
            raise SettingsError("feed-forward needs a fixed base; this model's base floats")
        n = tree.n
        self.gravity = np.asarray(gravity, dtype=np.float64)
        self._parent, self._base = tree.parent, base_at_rest(gravity)[None]
        self._effects = effects_by_name(effect_names)
        self._known = by_joint(known, n) if known else None
        # position, velocity, acceleration, torque: a table of one instant each
        self._signals, self._still = np.zeros((4, 1, n)), np.zeros(n)
        self._motion = JointMotion(*self._signals[:3])
        self._bristles, self._bent = Bristles.unknown(n), np.zeros(len(WAYS_RAD) * n)
        self._straight = np.zeros((len(WAYS_RAD), n))
        self._asked: tuple[Array | None, ...] = (None, None, None)
        self._said = self._still
        self.set(np.zeros((n, 6)), np.zeros((n, 10)), np.zeros((len(self._effects), n)))
        self(*np.zeros((3, n)))  # compiled now, not in the first tick
        self._bristles.place[:] = np.nan

    @classmethod
    def of(cls, model: SelfModel) -> ModelFeedforward:
        """Of a model as it stands, with its tool and its effects that have no end."""
        model = with_bodies(model)
        known = lasting_effects(model.effects, model.tree.n)
        forward = cls(model.tree, model.gravity, known=known)
        forward.set(model.lam, model.theta_with_tool(), np.zeros((0, model.tree.n)))
        return forward

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

    def set(
        self, lam: Array, theta: Array, effect_values: Array, shapes: Array | None = None
    ) -> None:
        """Take parameters: λ (n, 6), θ (n, 10) of arm and tool, (e, n) of the named effects.

        `shapes` (e, n) of effects that have several, as `Theta.shapes`.
        """
        self._asked = (None, None, None)
        self.frames = frames_of(self._parent, lam)
        self.theta = np.array(theta, dtype=np.float64).reshape(-1, 10)
        if shapes is None:
            shapes = np.full(np.shape(effect_values), np.nan)
        taken = zip(self._effects, effect_values, shapes, strict=True)
        parts = [(effect, value * effect.shares(shape)) for effect, value, shape in taken]
        self._parts = [part for part in parts if part[1].any()]

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion, which goes on from the one asked for before."""
        asked = self._asked
        if q is not asked[0] or dq is not asked[1] or ddq is not asked[2]:
            self._asked, self._said = (q, dq, ddq), self._moved(q, dq, ddq)
        return self._said.copy()

    def _moved(self, q: Array, dq: Array, ddq: Array) -> Array:
        wind(np.inf, q, dq, self._bristles, self._bent)
        return self._torque(q, dq, ddq, self._bent.reshape(-1, len(q)))

    def unbent(self, q: Array) -> Array:
        """Torques (n,) N m of holding still with nothing bent."""
        return self._torque(q, self._still, self._still, self._straight)

    def beside_bodies(self, q: Array, dq: Array, dt_s: float) -> Array:
        """Torques (n,) N m beside those of the rigid bodies, but for what ddq asks for.

        Args:
            q, dq: (n,) as measured, dt_s after those of the call before: bristles follow them.
        """
        wind(dt_s, q, dq, self._bristles, self._bent)
        return self._beside(q, dq, self._still, self._bent.reshape(-1, len(q)))

    def friction(self, dq: float) -> Array:
        """(n,) N m: half of what turning from -dq to dq (rad/s) changes, far from the turn."""
        still, speed = self._still, np.full(len(self._still), dq)
        ahead = self._beside(still, speed, still, self._straight + 1.0)
        return 0.5 * (ahead - self._beside(still, -speed, still, self._straight - 1.0))

    def motor_inertia(self) -> Array:
        """(n,) kg m²: what is beside the bodies and follows the joint's own acceleration."""
        still, one = self._still, np.ones(len(self._still))
        return self._beside(still, still, one, self._straight) - self._beside(
            still, still, still, self._straight
        )

    def _torque(self, q: Array, dq: Array, ddq: Array, bent: Array) -> Array:
        self._set_motion(q, dq, ddq)
        tau = self._rigid()
        return tau + self._beside(q, dq, ddq, bent, tau)

    def _set_motion(self, q: Array, dq: Array, ddq: Array) -> None:
        """Where the links move otherwise than the joints say, theirs."""
        signals, known = self._signals, self._known
        signals[0, 0], signals[1, 0], signals[2, 0] = q, dq, ddq
        if known is not None and known.moves:
            self._to_links(known)

    def _beside(
        self, q: Array, dq: Array, ddq: Array, bent: Array, rigid: Array | None = None
    ) -> Array:
        """What comes on top of the rigid bodies' torques (n,), computed here where it is needed."""
        signals, known = self._signals, self._known
        more: Array = np.zeros(len(q))
        if known is not None:
            if rigid is None:
                self._set_motion(q, dq, ddq)
                rigid = self._rigid()
            link, speed, pull = signals[0, 0], signals[1, 0], signals[2, 0]
            more = more + known.torque(JointSignals(link, speed, pull, rigid, bent=bent))
            if known.pushed:
                push = np.empty((1, len(rigid), 1))
                wrench_torques(self.frames, signals[0], known.wrench[:, None], push)
                more = more - push[0, :, 0]
            more = more + known.gain * (rigid + more)
        at = JointSignals(q, dq, ddq, bent=bent)
        for effect, parts in self._parts:
            for part, column in zip(parts, effect.basis(at), strict=True):
                more += part * column
        return more

    def _rigid(self) -> Array:
        tau = self._signals[3]
        torques(self.frames, self.theta, self._motion, self._base, tau)
        return tau[0].copy()

    def _to_links(self, known: ByJoint) -> None:
        """Put the links' motion in place of what the encoders say."""
        (q,), (dq,), (ddq,), (tau,) = self._signals
        lag = known.half_play * smooth_sign(dq)
        if known.compliance.any():
            self._rigid()
        pull = JointTorques(tau, self._still, self._still)
        to_links(JointMotion(q, dq, ddq), pull, Gears.of(known))
        q -= lag
