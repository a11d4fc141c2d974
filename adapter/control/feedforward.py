"""Torque that a model says a motion takes: gravity compensation and inverse dynamics.

Torques of joints beside the bodies at one instant are compiled. Most effects of a joint (offset,
friction, bristles, motor inertia, a spring) are linear in a few columns that one instant shows.
Which, and how much of each, is found by trying them (`shares_of`): no effect has to say so, and
what is something else is told apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import IntEnum

import numpy as np

from adapter.effects.active import Active, by_joint, lasting_effects, with_bodies
from adapter.effects.base import LearnedEffect
from adapter.effects.by_joint import SMOOTHING_DQ, WAYS_RAD, ByJoint, JointSignals, smooth_sign
from adapter.effects.catalogue import effects_by_name
from adapter.effects.link_angles import Gears, JointTorques, to_links
from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import (
    JointMotion,
    base_at_rest,
    frames_of,
    inverse_dynamics,
    jit,
    link_motion,
    torques,
    wrench_torques,
)
from adapter.signals.bristles import Bristles, wind


class Feedforward:
    """What a controller asks of a model, here of one that is not learned.

    Attributes:
        ready: whether its torques may be used.
        notes: what the user should be told of it.
    """

    ready = True
    notes: Sequence[str] = ()

    def attach(self, name: str) -> None:
        """Follow the estimate published under this name, where the model is a learned one."""

    def detach(self) -> None:
        """Follow it no longer."""

    def refresh(self) -> None:
        """Take over what is new; called every 50 ticks or so."""

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion (n,) rad, rad/s, rad/s². Raises nothing."""
        raise NotImplementedError

    def unbent(self, q: Array) -> Array:
        """Torques (n,) N m of holding still with nothing bent: gravity. Raises nothing."""
        raise NotImplementedError


def not_learned(documented: SelfModel, effect_names: Sequence[str]) -> list[Active]:
    """Lasting effects of a documented model but for its bodies and for those that are learned."""
    whole = with_bodies(documented)
    lasting = lasting_effects(whole.effects, whole.tree.n)
    return [active for active in lasting if not active.starts(effect_names)]


class ModelFeedforward(Feedforward):
    """Inverse dynamics of a fixed-base model, compiled; some 5 µs a call for 7 joints.

    What a model's effects do to a motion is computed from one instant: the links follow the
    encoders without the rates of a gear's twist, a gear with play leans on the flank that pushes
    it, and what needs time (a late sensor, friction that drifts) is left out. `torque.ModelTorque`
    does all of it over stamps. Bristles wind up along the motions asked for, one after the other.

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
        table: (`Row`, n) of its joints.
        odd: whether any effect is none that `table` can hold: `beside` then says its torque.
    """

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
        self._tree, self._base = tree, base_at_rest(gravity)
        self._effects = effects_by_name(effect_names)
        self._units = [_shares_of_effect(effect) for effect in self._effects]
        self._known, self._shares = _split(known, n)
        self.table, self._still = np.zeros((Row.END, n)), np.zeros(n)
        self.table[Row.PLACE] = np.nan  # bristles that nobody has seen
        self._q, self._dq, self._ddq, self._tau = self.table[: Row.TAU + 1]
        # position, velocity, acceleration, torque of the links: a table of one instant each
        self._links = np.zeros((4, 1, n))
        self._asked: tuple[Array | None, ...] = (None, None, None)
        self._said = self._still
        self.set(np.zeros((n, 6)), np.zeros((n, 10)), np.zeros((len(self._effects), n)))
        self(*np.zeros((3, n)))  # compiled now, not in the first tick
        self.table[Row.PLACE] = np.nan

    @classmethod
    def of(cls, model: SelfModel) -> ModelFeedforward:
        """Of a model as it stands, with its tool and its effects that have no end."""
        model = with_bodies(model)
        known = lasting_effects(model.effects, model.tree.n)
        forward = cls(model.tree, model.gravity, known=known)
        forward.set(model.lam, model.theta_with_tool(), np.zeros((0, model.tree.n)))
        return forward

    def set(
        self, lam: Array, theta: Array, effect_values: Array, shapes: Array | None = None
    ) -> None:
        """Take parameters: λ (n, 6), θ (n, 10) of arm and tool, (e, n) of the named effects.

        `shapes` (e, n) of effects that have several, as `Theta.shapes`.
        """
        self._asked = (None, None, None)
        self.frames = frames_of(self._tree, lam)
        self.theta = np.array(theta, dtype=np.float64).reshape(-1, 10)
        if shapes is None:
            shapes = np.full(np.shape(effect_values), np.nan)
        shares, self._parts = self._shares.copy(), []
        taken = zip(self._effects, self._units, effect_values, shapes, strict=True)
        for effect, units, values, shape in taken:
            parts = values * effect.shares(shape)
            if units is not None:
                shares += units @ parts
            elif parts.any():
                self._parts.append((effect, parts))
        self.table[Row.SHARES :] = shares
        self.odd = self._known is not None or bool(self._parts)

    def __call__(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (n,) N m of a motion, which goes on from the one asked for before."""
        asked = self._asked
        if q is not asked[0] or dq is not asked[1] or ddq is not asked[2]:
            self._asked, self._said = (q, dq, ddq), self._torque(q, dq, ddq, True)
        return self._said.copy()

    def unbent(self, q: Array) -> Array:
        """Torques (n,) N m of holding still with nothing bent."""
        return self._torque(q, self._still, self._still, False)

    def _torque(self, q: Array, dq: Array, ddq: Array, bends: bool) -> Array:
        self._q[:], self._dq[:], self._ddq[:] = q, dq, ddq
        fill_torque(self.frames, self.theta, self._base, self.table, bends)
        return self._tau + self._odd(1.0 if bends else 0.0) if self.odd else self._tau.copy()

    def odd_beside(self, q: Array, dq: Array, dt_s: float) -> Array:
        """Torques (n,) N m beside the bodies that `table` does not hold, but for what ddq asks for.

        Args:
            q, dq: (n,) as measured, dt_s after those of the call before: bristles follow them.
        """
        self._q[:], self._dq[:], self._ddq[:] = q, dq, 0.0
        wind_table(self.table, dt_s)
        return self._odd()

    def friction(self, dq: float) -> Array:
        """(n,) N m: half of what turning from -dq to dq (rad/s) changes, far from the turn."""
        return friction_of(self.table, dq) + self._half_change(Row.DQ, dq)

    def motor_inertia(self) -> Array:
        """(n,) kg m²: what is beside the bodies and follows the joint's own acceleration."""
        own: Array = self.table[Row.SHARES + 4] + self._half_change(Row.DDQ, 1.0)
        return own

    def _half_change(self, row: Row, size: float) -> Array:
        """(n,) N m: half of what the odd torques change from -size to size; bent that way."""
        if not self.odd:
            return self._still
        before, said = self.table.copy(), []
        for way in (1.0, -1.0):
            self._q[:], self._dq[:], self._ddq[:] = 0.0, 0.0, 0.0
            self.table[row] = way * size
            self.table[Row.BENT : Row.SHARES] = way if row == Row.DQ else 0.0
            said.append(self._odd())
        self.table[:] = before
        return 0.5 * (said[0] - said[1])

    def _odd(self, bent: float = 1.0) -> Array:
        """(n,) N m of what `table` does not hold, for the motion in it; bends times `bent`."""
        bends = bent * self.table[Row.BENT : Row.SHARES]
        at = JointSignals(self._q, self._dq, self._ddq, bent=bends)
        more = np.zeros(len(self._q)) if self._known is None else self._of_known(self._known, at)
        for effect, parts in self._parts:
            for part, column in zip(parts, effect.basis(at), strict=True):
                more += part * column
        return more

    def _of_known(self, known: ByJoint, at: JointSignals) -> Array:
        """What known effects change in the torques (n,) of the bodies."""
        links = self._links
        links[0, 0], links[1, 0], links[2, 0] = at.q, at.dq, at.ddq
        straight = self._rigid()
        if known.moves:
            (q,), (dq,), (ddq,), (tau,) = self._links  # the links' motion for the encoders'
            lag = known.half_play * smooth_sign(dq)
            pull = JointTorques(tau, self._still, self._still)
            to_links(JointMotion(q, dq, ddq), pull, Gears.of(known))
            q -= lag
        rigid, (q, dq, ddq) = self._rigid(), links[:3, 0]
        more = rigid - straight + known.torque(JointSignals(q, dq, ddq, rigid, bent=at.bent))
        if known.pushed:
            push = np.empty((1, len(rigid), 1))
            wrench_torques(self.frames, links[0], known.wrench[:, None], push)
            more = more - push[0, :, 0]
        return more + known.gain * (straight + more)

    def _rigid(self) -> Array:
        tau = self._links[3]
        torques(self.frames, self.theta, JointMotion(*self._links[:3]), self._base[None], tau)
        return tau[0].copy()


def _shares_of_effect(effect: LearnedEffect) -> Array | None:
    """(COLUMNS, K) of each part of a learned effect, by its unit; None where of none."""
    parts = range(0 if effect.by else len(effect.shapes) or 1)
    found = [shares_of(lambda at, k=k: effect.basis(at)[k], 1) for k in parts]  # type: ignore[misc]
    shares = [x for x in found if x is not None]
    return np.hstack(shares) if shares and len(shares) == len(found) else None


def _split(known: Sequence[Active], n: int) -> tuple[ByJoint | None, Array]:
    """Known effects that a table does not hold, and the shares (COLUMNS, n) of those it does."""
    nothing = np.zeros((COLUMNS, n))
    if not known:
        return None, nothing
    sums = by_joint(known, n)
    bodies = sums.moves or sums.pushed or bool(sums.gain.any())
    shares = None if bodies else shares_of(sums.torque, n)
    return (sums, nothing) if shares is None else (None, shares)


WAYS = len(WAYS_RAD)
COLUMNS = 5 + WAYS  # one, q, dq, its direction, ddq, how far bristles are bent
TRIED, ALIKE = 40, 1e-9  # instants; share by which the columns may be off


class Row(IntEnum):
    """Rows of the table of one model's joints, (n,) each."""

    Q = 0  # rad
    DQ = 1  # rad/s
    DDQ = 2  # rad/s²
    TAU = 3  # filled: torque, N m
    PLACE = 4  # of the bristles, as are the next ones
    EDGE = 5
    DIRECTION = 6
    HELD = 7
    BENT = 7 + WAYS
    SHARES = 7 + 2 * WAYS  # of the columns
    END = 7 + 2 * WAYS + COLUMNS


def shares_of(torque: Callable[[JointSignals], Array | float], n: int) -> Array | None:
    """(COLUMNS, n) shares of which this torque of n joints consists; None where of none."""
    rng = np.random.default_rng(0)
    q, dq, ddq, tau = rng.uniform(-1.0, 1.0, (4, TRIED, n))
    dq *= np.abs(dq)  # slow ones, too, where the direction is no sign yet
    bent = rng.uniform(-1.0, 1.0, (WAYS, TRIED, n))
    said = np.array(np.broadcast_to(torque(JointSignals(q, dq, ddq, tau, bent=bent)), q.shape))
    columns = np.array([np.ones_like(q), q, dq, smooth_sign(dq), ddq, *bent]).transpose(2, 1, 0)
    shares = np.linalg.pinv(columns) @ said.T[..., None]
    off = np.abs((columns @ shares)[..., 0] - said.T).max()
    if not off <= ALIKE * max(1.0, float(np.abs(said).max())):
        return None
    return np.where(np.abs(shares) > ALIKE, shares, 0.0)[..., 0].T.copy()


@jit
def wind_table(table, dt_s):
    """Let the bristles of a table go along with its q and dq, dt_s after those before."""
    held, bent = table[Row.HELD.value : Row.BENT.value], table[Row.BENT.value : Row.SHARES.value]
    way = Bristles(table[Row.PLACE.value], table[Row.EDGE.value], table[Row.DIRECTION.value], held)
    wind(dt_s, table[Row.Q.value], table[Row.DQ.value], way, bent.reshape(-1))


@jit
def beside(table, j, bends):
    """Torque of joint j that the columns make, N m; as if nothing were bent unless it `bends`."""
    first, dq = Row.SHARES.value, table[Row.DQ.value, j]
    tau = table[first, j] + table[first + 1, j] * table[Row.Q.value, j] + table[first + 2, j] * dq
    tau += table[first + 3, j] * math.tanh(dq / SMOOTHING_DQ)
    tau += table[first + 4, j] * table[Row.DDQ.value, j]
    if bends:
        for k in range(WAYS):
            tau += table[first + 5 + k, j] * table[Row.BENT.value + k, j]
    return tau


@jit
def fill_torque(frames, theta, base, table, bends):
    """Fill `TAU` of a table: what its motion takes, bristles wound along it unless still.

    Args:
        frames: `Frames`; theta: (n, 10); base: (12,) motion row of the base.
        table: (END, n); bends: whether bristles go along, or nothing is bent.
    """
    joints = JointMotion(table[Row.Q.value], table[Row.DQ.value], table[Row.DDQ.value])
    if bends:
        wind_table(table, math.inf)
    motion = np.empty((table.shape[1], 12))
    link_motion(frames, joints, base, motion)
    inverse_dynamics(frames, theta, joints.q, motion, base, table[Row.TAU.value])
    for j in range(table.shape[1]):
        table[Row.TAU.value, j] += beside(table, j, bends)


def friction_of(table: Array, dq: float) -> Array:
    """(n,) N m: half of what turning from -dq to dq (rad/s) changes in it, far from the turn."""
    shares = table[Row.SHARES :]
    slide: Array = shares[2] * dq + shares[3] * smooth_sign(np.array(dq)) + shares[5:].sum(axis=0)
    return slide
