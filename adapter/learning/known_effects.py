"""Filtered states freed of the effects that a model brings along and nobody learns.

Signals leave the joint filter as if everything before it had gone through the same low-pass, so
what is linear in them (offsets, gains, twists of gears, delays) is undone after it; what jumps
(friction) is as smooth as the learner's own columns. Rates of torque come from the state before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.effects.active import Active, by_joint, lasting_effects, with_bodies
from adapter.effects.catalogue import LEARNED, effects_by_name
from adapter.effects.law import AT, LearnedLaw, OverSignals
from adapter.effects.link_angles import Gears, JointTorques, to_links
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import JointMotion, jit
from adapter.physics.rigid_arm import RigidArm
from adapter.signals.records import KIND, LinkMotionKind, StateLayout, columns, stamps_of

NOT_THERE = 1e-6  # of its usual size: a law with less doubt is one that a joint has not


@jit
def to_joints(stamps, table, sensors, gears, clock, memory):
    """Undo what sensors and gears do to states (m, size), in place, one after the other.

    Args:
        stamps: (m,) int64 ns; table: (m, size) of `StateLayout`.
        sensors: half the gears' play, gain and delay of the torque sensors, (n,) each, see
            `ByJoint`; gears: `Gears`.
        clock: (2,) int64 stamp of the state before, and states since a hole, at most 2.
        memory: (4, n) torque of the state before, its rate, link angle behind the play, second
            rate of torque.
    """
    half, gain, delay = sensors
    n = half.shape[0]
    at = columns(n, False)
    lag, rate, jerk = np.empty(n), np.empty(n), np.empty(n)
    for m in range(table.shape[0]):
        q, dq = table[m, at.q : at.dq], table[m, at.dq : at.ddq]
        ddq, tau = table[m, at.ddq : at.tau], table[m, at.tau : at.base]
        step = stamps[m] - clock[0]
        if step <= 0 or step > 20_000_000:  # between two states that a rate is taken from
            clock[1] = 0
        dt = 1e-9 * step
        for j in range(n):
            rate[j] = (tau[j] - memory[0, j]) / dt if clock[1] >= 1 else 0.0
            # the second rate of torque is small against its noise: followed slowly
            newest = (rate[j] - memory[1, j]) / dt if clock[1] >= 2 else 0.0
            old = memory[3, j] if clock[1] >= 2 else 0.0
            # On a Panda's noise and 4000 N m/rad, the error that twist leaves on the worst joint's
            # torque: 0.10 N m without smoothing, 0.01 with.
            memory[3, j] = old + (newest - old) * dt / (dt + 0.03)
            jerk[j] = memory[3, j]
            memory[0, j], memory[1, j] = tau[j], rate[j]
            if clock[1] == 0:  # before it is known better, the motor pushes the way it moves
                memory[2, j] = q[j] - half[j] * np.sign(dq[j])
            memory[2, j] = min(max(memory[2, j], q[j] - half[j]), q[j] + half[j])
            lag[j] = q[j] - memory[2, j]
            scale = 1.0 / (1.0 + gain[j])
            tau[j] = (tau[j] + delay[j] * rate[j]) * scale
            rate[j], jerk[j] = rate[j] * scale, jerk[j] * scale
        to_links(JointMotion(q, dq, ddq), JointTorques(tau, rate, jerk), gears)
        q -= lag
        clock[0] = stamps[m]
        clock[1] = min(clock[1] + 1, 2)


def learnable(model: SelfModel, names: Sequence[str]) -> tuple[str, ...]:
    """Effects to learn: these, and after them what the model has that can be learned further."""
    lasting = lasting_effects(model.effects, model.tree.n)
    told = dict.fromkeys(name for x in lasting for name in x.starts())
    return tuple(dict.fromkeys([*names, *(x for x in LEARNED if x in told), *told]))


def as_told(model: SelfModel, names: Sequence[str]) -> tuple[str, ...]:
    """These names; a law that the model has is learned at the setting that it has there."""
    own, found = learnable(model, ()), dict[str, None]()
    for name in names:
        same = [x for x in own if x.partition(AT)[0] == name.partition(AT)[0]]
        found |= dict.fromkeys(same or [name])
    return tuple(found)


def not_learned(model: SelfModel, names: Sequence[str]) -> list[str]:
    """What is said of lasting effects that the learner leaves out, and of laws that it holds."""
    whole = with_bodies(model)
    lasting = lasting_effects(whole.effects, whole.tree.n)
    said = [f"the learner leaves out {x}" for x in by_joint(lasting, whole.tree.n).left_out]
    laws = [x for x in lasting if isinstance(x.effect, OverSignals) and not x.starts(names)]
    held = "stays as it is: it is not learned online"
    return said + [f"joint {x.joint + 1}: {x.effect.title}, {held}" for x in laws]


def believed(known: Sequence[Active], names: Sequence[str], n: int) -> tuple[Array, Array] | None:
    """(e, n) values and standard deviations that a model gives of learned effects, else None.

    NaN where it has no such effect on a joint; a law is held to be on no other joints than the
    model's. Without a standard deviation in the model it is the effect's own prior one.
    """
    effects = effects_by_name(names)
    total, variance = np.zeros((len(effects), n)), np.full((len(effects), n), np.nan)
    for active in known:
        for k, (name, value) in enumerate(active.starts(names).items()):
            at = names.index(name), active.joint
            effect = effects[at[0]]
            std = active.std.get(effect.key) if k == 0 else None
            widest = effect.learned_std
            known_to = None if std is None or not np.isfinite(std) else float(std)
            spread = widest if known_to is None else max(known_to, 1e-3 * widest)  # not surer
            total[at] += value
            variance[at] = np.nan_to_num(variance[at]) + spread**2
    for k, effect in enumerate(effects):
        if isinstance(effect, LearnedLaw) and np.isfinite(variance[k]).any():
            nowhere = np.isnan(variance[k])
            variance[k, nowhere] = (0.5 * NOT_THERE * effect.learned_std) ** 2
    told = np.isfinite(variance)
    return (np.where(told, total, np.nan), np.sqrt(variance)) if told.any() else None


def told_shapes(known: Sequence[Active], names: Sequence[str], n: int) -> Array:
    """(e, n) shapes that a model gives of learned effects, NaN where it gives none."""
    shapes = np.full((len(names), n), np.nan)
    for active in known:
        key = getattr(active.effect, "shape_key", "")
        if key and active.effect.name in names:
            shapes[names.index(active.effect.name), active.joint] = float(active.values[key])
    return shapes


class KnownEffects:
    """Takes off states what known effects put on; keeps the little that needs a state before.

    Args:
        effects: lasting ones, none of bodies (`with_bodies`), none being learned.
        arm: the rigid arm; its frames carry a wrench to the joints.
        smoothing_s: how long the filter takes a step of torque.

    Attributes:
        clock, memory: see `to_joints`.
        left_out: names of effects that are not undone.
    """

    def __init__(self, effects: Sequence[Active], arm: RigidArm, smoothing_s: float) -> None:
        n = arm.n
        self._layout, self._arm, self._smoothing_s = StateLayout(n), arm, smoothing_s
        self._own = own = by_joint(effects, n)
        self._gears = Gears.of(own)
        turned = own.offset.any() or own.ripple.any()
        self._encoders = self._gears._replace(compliance=np.zeros(n)) if turned else None
        self._sensed = own.moves or bool(own.gain.any() or own.delay_s.any())
        self.clock, self.memory = np.zeros(2, dtype=np.int64), np.zeros((4, n))
        self.left_out = own.left_out
        self.take_off(self._layout.new(1))  # compiled now, not at the first state
        self.clock[:], self.memory[:] = 0, 0.0

    def take_off(self, table: Array) -> Array:
        """A copy of filtered states (m, size), in order, as an arm without the effects gives them.

        Where link motion was measured, the encoders' errors leave the angles it goes with too;
        motion that was synthesized from the encoders' angles stays with them.
        """
        at, own = self._layout, self._own
        table = table.copy()
        if self._sensed:
            stamps = stamps_of(table)
            sensors = own.half_play, own.gain, own.delay_s
            to_joints(stamps, table, sensors, self._gears, self.clock, self.memory)
        q, tau = table[:, at.q], table[:, at.tau]
        if own.pushed:
            tau += self._arm.wrench_torque(q, own.wrench)
        signals = at.signals(table, self._smoothing_s)
        if own.by_load:
            signals = signals._replace(tau=tau - own.torque(signals))
        if own.laws:
            tau -= own.torque(signals)
        if self._encoders is not None:
            still, unused = np.zeros(at.n), np.zeros(at.n)
            untwisted = JointTorques(still, still, still)
            for m in np.flatnonzero(table[:, KIND] >= LinkMotionKind.MEASURED):
                motion = JointMotion(table[m, at.motion_q], table[m, at.motion_dq], unused)
                to_links(motion, untwisted, self._encoders)
        return table
