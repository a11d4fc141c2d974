"""What a simulator's file of an arm leaves out, as joint torques to add in every step.

The motion is the simulator's own: what acts in the drives and joints comes as a torque on the
joint (`Effects.__call__`), what encoders and torque sensors make of it as a reading
(`Effects.measured`). Each effect says itself where it belongs, by its class in `effects.base`:

    TorqueEffect   friction, springs, ripple, motor inertia, a wrench at the flange: torque. What
                   bends before it slides remembers the way
    BodyEffect     payload, link inertia, base tilt: in the file; where they come or go in
                   mid-recording, the difference to the file as torque
    MotionEffect   encoder offset and ripple, elasticity, backlash: read q, dq. The encoder sits on
                   the motor's side of the gear, so the joint's torque moves the link as it is
    SensorEffect   gain, delay and low-pass of the torque sensors, and their offset: read tau

What friction does in a step: what is stiff is solved for, and bristles remember the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from adapter.effects.active import Active, active_effects, by_joint, with_bodies
from adapter.effects.base import BodyEffect, JointTorque, Motion, SensorEffect, TorqueEffect
from adapter.effects.bristle_friction import Rubs, bend
from adapter.effects.by_joint import SMOOTHING_DQ, ByJoint, JointSignals, smooth_sign
from adapter.effects.robots import additions
from adapter.effects.torque import arm_between, moved_links
from adapter.errors import ModelError, SettingsError
from adapter.model.filled import PLACES
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.model.urdf_text import ARMATURE, CUBIC_DRAG, DAMPING, DRAG, FRICTION, STIFFNESS
from adapter.physics.kernels import jit
from adapter.physics.rigid_arm import RigidArm

# What the joints of a file have beside the bodies, by the format's name.
FORMATS: dict[str, tuple[str, ...]] = {
    "bodies": (),
    "bodies and armature": (ARMATURE,),
    "pybullet": (DAMPING,),
    "urdf": PLACES["urdf"],
    "mjcf": PLACES["mjcf"],
}
CROSSING_S = 0.01  # the motor crosses the gear's play in this time
BAND_HZ = 25.0  # of what twists an elastic joint before a simulation begins
SLOPE = 1e-3  # rad/s or rad/s² over which a law's slopes are taken
ROUNDS, STAYS = 8, 1e-6  # of laws that go with ddq; rad/s² by which the last one changes nothing
# A law is asked five times at once: without direction, forwards, backwards, faster, accelerated.
DIRECTIONS, FASTER, ACCELERATED = np.array(
    [[0.0, 1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, SLOPE, 0.0], [0.0, 0.0, 0.0, 0.0, SLOPE]]
)[..., None]


class _Asked(JointSignals):
    """Signals (5, n) whose direction of motion is told."""

    direction = DIRECTIONS


class _AskedMotion(Motion):
    """The same over a table."""

    @property
    def direction(self) -> Array:
        """As told."""
        return np.broadcast_to(DIRECTIONS, self.q.shape)


@dataclass(frozen=True, eq=False)
class _Stage:
    """What acts between two switches.

    Attributes:
        arm: the rigid body; laws: torques of joints by their own signals; by_others: by another's;
            others: torques that only a table knows; bent: those of bristles.
        sensors: what encoders and torque sensors do; shifts: what the latter add last of all.
        rounds: how often laws are asked, of which some go with the step's own acceleration.
    """

    arm: RigidArm
    laws: ByJoint
    by_others: ByJoint
    others: tuple[Active, ...]
    bent: tuple[Active, ...]
    sensors: ByJoint
    shifts: ByJoint
    rounds: int

    @classmethod
    def of(cls, arm: RigidArm, acting: Sequence[Active]) -> _Stage:
        """Of the effects that act in it."""
        torques, last = [], []
        for a in acting:
            if isinstance(a.effect, TorqueEffect):
                torques.append(a)
                last += [a] if a.effect.after_sensors else []
        bent = with_bristles(torques)
        laws = [a for a in torques if isinstance(a.effect, JointTorque) and a not in last + bent]
        kinds = [a.effect for a in laws if isinstance(a.effect, JointTorque)]
        n, follow = arm.n, any(x.by_load or "ddq" in x.variables for x in kinds)
        return cls(
            arm,
            by_joint([a for a in laws if not a.effect.by], n),
            by_joint([a for a in laws if a.effect.by], n),
            tuple(a for a in torques if a not in laws + last + bent),
            tuple(bent),
            by_joint([a for a in acting if a not in torques], n),
            by_joint(last, n),
            ROUNDS if follow else 1,
        )


@dataclass(frozen=True, eq=False)
class _Asking:
    """What laws say about an instant, (n,): rest + viscous dq + level sign(dq) + armature ddq."""

    rest: Array
    viscous: Array
    forwards: Array
    backwards: Array
    armature: Array

    @classmethod
    def of(cls, said: Array, dq: Array, ddq: Array) -> _Asking:
        """Of answers (5, n) about dq, ddq (n,); friction that drives is none, and acts as it is."""
        forwards, backwards = said[1] - said[0], said[0] - said[2]
        level = np.where(dq > 0.0, forwards, backwards)
        driving = np.minimum(level, 0.0) * np.tanh(dq / SMOOTHING_DQ)
        viscous = np.maximum((said[3] - said[0]) / SLOPE, 0.0)
        least = np.maximum(forwards, 0.0), np.maximum(backwards, 0.0)
        armature = (said[4] - said[0]) / SLOPE
        rest = said[0] - viscous * dq - armature * ddq + driving
        return cls(rest, viscous, *least, armature)

    def torque(self, u: Array, ddq: Array) -> Array:
        """(n,) N m at the speed u, rad/s, and the acceleration ddq, rad/s²."""
        level = np.where(u > 0.0, self.forwards, self.backwards)
        return self.rest + self.viscous * u + level * smooth_sign(u) + self.armature * ddq


class Effects:
    """The effects of a model in a simulator that steps its rigid arm.

    The torque remembers nothing but the way of joints with bristles and may be asked for as often
    as an integrator likes; what is read has a memory (play of the gears, delay lines), so
    `measured` is called once a step and `reset` when the arm is put somewhere else.

    Args:
        model: on a fixed base.
        period_s: of the simulator's step. Friction, springs' damping and motor inertia are taken
            at the end of the step (see `friction.speed_change`), which needs its length.
        holds: what the simulator's arm has of the effects already, so that nothing counts twice:
            "mjcf" what `adapter export --mjcf` writes, "urdf" what `--urdf` does and MuJoCo reads,
            "pybullet" what PyBullet takes of that (no friction), "bodies" no damping, friction,
            armature or springs. All of them hold the inertias, payloads, the base's tilt and the
            encoders' zero. `MujocoArm` and `PybulletArm` see to this by themselves.

    Attributes:
        joint_names: order of all (n,).
        left_out: names of effects that no simulation has.

    Raises:
        ModelError: a floating base, an effect that is not in the catalogue.
        SettingsError: an unknown format; a period that is not above 0.
    """

    def __init__(self, model: SelfModel, period_s: float = 1e-3, holds: str = "mjcf") -> None:
        if holds not in FORMATS:
            raise SettingsError(f"no format '{holds}'; have: {', '.join(FORMATS)}")
        if not period_s > 0.0:
            raise SettingsError(f"a step of {period_s} s; needs more than 0")
        if model.tree.floating:
            raise ModelError(f"{model.name} has a floating base; effects need a fixed one")
        n = model.tree.n
        self.period_s, self.joint_names = period_s, model.tree.joint_names
        self._nothing = np.zeros(n)
        self._arm, self._held = RigidArm.of(model), RigidArm.of(with_bodies(model))
        self._active = active_effects(model.effects, n)
        self._holds = additions(model, FORMATS[holds])
        ends = {float(x) for a in self._active for x in a.interval_s if np.isfinite(x)}
        self._switches = np.array(sorted(ends))
        self._stages: dict[int, _Stage] = {}
        self._bristles = Bristles(self._active, n, period_s)
        self._slow: list[tuple[Active, float, float]] = []  # of one joint, and their low-pass
        kinds = TorqueEffect, BodyEffect
        told = {a.effect.name for a in self._active if isinstance(a.effect, kinds)}
        for a in self._active:
            filtered = a.effect.low_pass(a.values) if isinstance(a.effect, SensorEffect) else None
            if filtered:
                told.add(a.effect.name)
                joints = range(n) if a.joint < 0 else (a.joint,)
                self._slow += [(replace(a, joint=j), *filtered) for j in joints]
        silent = by_joint(self._active, n).left_out
        self.left_out = tuple(name for name in silent if name not in told)
        self.reset()

    def reset(self) -> None:
        """Forget what the sensors remember."""
        self._gap: Array | None = None
        self._past: list[tuple[float, Array]] = []  # newest first: s, driving torque
        self._read: dict[int, tuple[float, float]] = {}  # last two of each low-pass, N m
        self._bristles.reset()

    def held(self, place: str) -> Array:
        """(n,) what the simulator's joints hold in one of its places, see `model.urdf_text`."""
        return self._holds.joint.get(place, self._nothing)

    def __call__(
        self, q: Array, dq: Array, ddq: Array | None, tau: Array, t: float | None = None
    ) -> Array:
        """Torque (n,) N m to add at the joints in the step that begins now.

        Args:
            q, dq: (n,) rad, rad/s, of the simulator's joints.
            ddq: (n,) rad/s² in the last step; None where unknown. What a gear carries follows it.
            tau: (n,) N m, what else acts on the joints in this step: drives, not gravity. Whether
                a joint at rest breaks loose depends on it.
            t: s since the recording began that the effects' times refer to; None: those without
                an end act, as if long begun.
        """
        stage = self._stage(t)
        acting = stage.laws.laws or stage.by_others.laws or stage.others or stage.bent
        if not acting and stage.arm is self._held:
            return self._nothing.copy()
        return self.at_middle(q, dq, ddq, tau, t, 0.0)

    def at_middle(
        self, q: Array, dq: Array, ddq: Array | None, tau: Array, t: float | None, part: float = 0.5
    ) -> Array:
        """The same, and what makes the simulator's step one of second order.

        Simulators take what hangs on the speed (Coriolis torques) at the step's start; here it is
        that of its middle, as far as the last step's acceleration tells.

        Args:
            q, dq, ddq, tau, t: as above.
            part: of the step.
        """
        q, dq, tau = (np.asarray(x, dtype=float) for x in (q, dq, tau))
        stage, link = self._stage(t), q - self._holds.offset
        last = self._nothing if ddq is None else np.asarray(ddq, dtype=float)
        M, bias = _dynamics(self._held, link, dq)
        body, carried = M, bias
        if part or stage.arm is not self._held:
            body, carried = _dynamics(stage.arm, link, dq + part * self.period_s * last)
        a, u = last, dq
        bent = self._bristles.torque(q, dq, body, stage.bent)
        for _ in range(stage.rounds):
            at = JointSignals(link, dq, a, carried + body @ a)
            asked = _Asking.of(self._said(stage, at, t) + bent, dq, a)
            losses = np.array([asked.viscous, asked.forwards, asked.backwards])
            push = tau - carried - asked.rest
            dv, u = speed_change(body + np.diag(asked.armature), push, dq, losses, self.period_s)
            before, a = a, dv / self.period_s
            if np.abs(a - before).max() < STAYS:
                break
        own = carried + body @ a + asked.torque(u, a)
        # what the simulator takes off at the joints by itself
        pull = self.held(STIFFNESS) * q + self._holds.pull
        drag = self.held(DAMPING) + self.held(DRAG) * np.abs(u) + self.held(CUBIC_DRAG) * u**2
        lost = drag * u + self.held(FRICTION) * smooth_sign(u)
        return np.asarray(bias + M @ a + (pull + lost + self.held(ARMATURE) * a) - own)

    def measured(
        self, q: Array, dq: Array, tau: Array, t: float | None = None
    ) -> tuple[Array, Array, Array]:
        """What the sensors say of q, dq and the driving torque tau, (n,) each; once a step."""
        sensors, now = self._stage(t).sensors, self._clock(t)
        last_s, last = self._past[0] if self._past else (now, tau)
        passed_s = now - last_s if now > last_s else self.period_s
        rate = (tau - last) / passed_s
        gap, crossing = self._play(sensors.half_play, dq, passed_s)
        turn = sensors.compliance
        q_read = q - self._holds.offset + turn * tau + gap
        dq_read = dq + turn * rate + crossing
        angle = q_read + sensors.phase
        dq_read = dq_read * (1.0 + sensors.ripple * np.cos(angle))
        q_read = q_read + sensors.ripple * np.sin(angle) + sensors.offset
        self._past.insert(0, (now, tau))
        return q_read, dq_read, self._sensed(t, now)

    def links(self, t: Array, q: Array, dq: Array, tau: Array) -> tuple[Array, Array]:
        """q, dq (m, n) of the simulator's joints where the sensors read this at t (m,) s.

        Args:
            tau: (m, n) driving torque, N m.
        """
        ddq = np.gradient(dq, t, axis=0)
        read = Motion(t, q, dq, ddq, self._arm, np.full_like(q[0], BAND_HZ))
        moved = moved_links(read, self._active, tau)
        self._bristles.follow(t, moved.q, moved.dq)
        return moved.q + self._holds.offset, moved.dq

    def settle(self, q: Array, dq: Array, tau: Array, t: float, read: Array) -> None:
        """Start anew with the gears' play such that the encoders read `read` (n,) rad."""
        self.reset()
        self._bristles.settle(t, q)
        half = self._stage(t).sensors.half_play
        if half.any():
            self._gap = self._nothing
            without = self.measured(q, dq, tau, t)[0] - self._gap
            self._gap = np.clip(read - without, -half, half)
            self._past.clear()

    def driving(self, t: Array, read: Array) -> Array:
        """Driving torque (m, n) N m behind what the torque sensors read at t (m,) s."""
        stages = [self._stage(float(now)) for now in t]
        sensed = ((x.sensors, x.shifts.laws) for x in {*stages})
        untrue = any(x.gain.any() or x.delay_s.any() or shifts for x, shifts in sensed)
        if not untrue and not self._slow:
            return read
        read = read.copy()
        for active, a, b in self._slow:  # torques of which the sensors' low-passes leave these
            rate = np.gradient(read[:, active.joint], t)
            more = a * rate + b * np.gradient(rate, t)
            on = active.on(t)
            read[:, active.joint] += more if on is None else more * on
        at = JointSignals(*np.zeros((3, *read[0].shape)))
        shift = np.array([stage.shifts.torque(at) + self._nothing for stage in stages])
        out = (read - shift) / (1.0 + np.array([stage.sensors.gain for stage in stages]))
        late = np.array([stage.sensors.delay_s for stage in stages])
        for j in np.flatnonzero(late.any(axis=0)):
            out[:, j] = np.interp(t + late[:, j], t, out[:, j])
        return out

    def _stage(self, t: float | None) -> _Stage:
        """What acts at t; what has no end where t is None."""
        ends = self._switches
        k = len(ends) if t is None else int(np.searchsorted(ends, t + 1e-9, side="right"))
        if k not in self._stages:
            begin = ends[k - 1] if k > 0 else -np.inf
            end = ends[k] if k < len(ends) else np.inf
            acting = [
                a for a in self._active if a.interval_s[0] <= begin and end <= a.interval_s[1]
            ]
            now, held = arm_between(self._arm, acting, begin, end), self._held
            same = (now.theta == held.theta).all() and (now.gravity == held.gravity).all()
            arm = held if same else self._arm.changed(now.theta, now.gravity)
            self._stages[k] = _Stage.of(arm, acting)
        return self._stages[k]

    def _said(self, stage: _Stage, at: JointSignals, t: float | None) -> Array:
        """Torque (5, n) of all laws, asked five times, at signals (n,)."""
        q, dq, ddq, load = (np.tile(x, (5, 1)) for x in at[:4])
        dq, ddq = dq + FASTER, ddq + ACCELERATED
        said = stage.laws.torque(_Asked(q, dq, ddq, load)) + np.zeros(q.shape)
        middle = at._replace(dq=at.dq + 0.5 * self.period_s * at.ddq)
        said += stage.by_others.torque(middle)
        for active in stage.others:
            assert isinstance(active.effect, TorqueEffect)
            begin = active.interval_s[0]
            since = self._clock(t) - (begin if np.isfinite(begin) else 0.0)
            motion = _AskedMotion(np.full(5, since), q, dq, ddq, stage.arm)
            said += active.effect.torque(motion, load, active.joint, active.values)
        return said

    def _play(self, half: Array, dq: Array, passed_s: float) -> tuple[Array, Array]:
        """By how much (n,) the motors are ahead of the links, and its rate."""
        if not half.any():
            return self._nothing, self._nothing
        way = np.clip(dq / SMOOTHING_DQ, -1.0, 1.0)
        before = half * way if self._gap is None else self._gap
        crossed = 2.0 * half * way * passed_s / CROSSING_S
        self._gap = np.clip(before + crossed, -half, half)
        return self._gap, (self._gap - before) / passed_s

    def _sensed(self, t: float | None, now: float) -> Array:
        """What the torque sensors say (n,): late, then scaled, then shifted."""
        stage, tau = self._stage(t), self._past[0][1]
        late = np.maximum(stage.sensors.delay_s, 0.0)
        longest = now - late.max()
        while len(self._past) > 2 and self._past[-2][0] < longest:
            self._past.pop()
        if late.any():
            times, rows = (np.array(x[::-1]) for x in zip(*self._past, strict=True))
            each = zip(late, rows.T, strict=True)
            tau = np.array([np.interp(now - d, times, x) for d, x in each])
        tau, clock = tau.copy(), self._clock(t)
        for k, (active, a, b) in enumerate(self._slow):  # by the implicit Euler method
            before, last = self._read.get(k, (tau[active.joint],) * 2)
            a, b = a / self.period_s, b / self.period_s**2
            new = (tau[active.joint] + a * last + b * (2.0 * last - before)) / (1.0 + a + b)
            self._read[k] = last, new
            if active.interval_s[0] <= clock < active.interval_s[1]:
                tau[active.joint] = new
        at = JointSignals(*np.zeros((3, len(tau))))
        return np.asarray((1.0 + stage.sensors.gain) * tau + stage.shifts.torque(at))

    def _clock(self, t: float | None) -> float:
        """t; without one, steps counted since the last reset."""
        if t is not None:
            return float(t)
        return self._past[0][0] + self.period_s if self._past else 0.0


def _dynamics(arm: RigidArm, q: Array, dq: Array) -> tuple[Array, Array]:
    """Mass matrix (n, n) kg m² and torque (n,) N m at rest of ddq, by inverse dynamics."""
    n = arm.n
    speed, ddq = np.zeros((2, n + 2, n))
    speed[0], ddq[2:] = dq, np.eye(n)
    tau = arm.torque(np.tile(q, (n + 2, 1)), speed, ddq)
    return tau[2:] - tau[1], tau[0]


DONE = 1e-10  # rad/s
ENOUGH = 1e-4  # share of the expected descent that a step must bring


@jit
def speed_change(M, push, v, losses, h):
    """Change of speed dv (n,) rad/s and the speed (n,) at which friction acts in a step of h (s).

    Solves M dv = h (push - f(v + share dv)), f(u) = viscous u + level tanh(u / SMOOTHING_DQ), by
    Newton's method on the convex function whose gradient that is. The share is one half (second
    order) where friction is not stiff, and goes to one where it is: with the friction of the
    step's start, or of its middle, a joint would swing about its standstill.

    Args:
        M: (n, n) mass matrix with what turns with the joints, kg m².
        push: (n,) all other torques, N m.
        v: (n,) speed at the start, rad/s.
        losses: (3, n) viscous, N m s/rad, level forwards and backwards, N m; none negative.
    """
    n = v.shape[0]
    dv, share, step = np.zeros(n), np.empty(n), np.empty(n)
    gradient, hessian = np.empty(n), np.empty((n, n))
    for i in range(n):
        stiff = (losses[0, i] + max(losses[1, i], losses[2, i]) / SMOOTHING_DQ) * h / M[i, i]
        share[i] = max(0.5, 1.0 - 1.0 / max(stiff, 1.0))
    cost = _cost(M, h * push, v, (losses, share, h), dv)
    for _ in range(60):
        gradient[:] = M @ dv - h * push
        hessian[:] = M
        for i in range(n):
            u = v[i] + share[i] * dv[i]
            level = losses[1, i] if u > 0.0 else losses[2, i]
            s = np.tanh(u / SMOOTHING_DQ)
            slope = losses[0, i] + level / SMOOTHING_DQ * (1.0 - s * s)
            gradient[i] += h * (losses[0, i] * u + level * s)
            hessian[i, i] += h * share[i] * slope
        step[:] = np.linalg.solve(hessian, -gradient)
        descent = gradient @ step
        new = _cost(M, h * push, v, (losses, share, h), dv + step)
        while new > cost + ENOUGH * descent and np.abs(step).max() > DONE:
            step *= 0.5
            descent *= 0.5
            new = _cost(M, h * push, v, (losses, share, h), dv + step)
        dv += step
        cost = new
        if np.abs(step).max() < DONE:
            break
    return dv, v + share * dv


@jit
def _cost(M, kick, v, friction, dv):
    """dv'M dv / 2 - kick dv + h times the potential of the losses."""
    losses, share, h = friction
    total = 0.5 * dv @ (M @ dv) - kick @ dv
    for i in range(v.shape[0]):
        u = v[i] + share[i] * dv[i]
        level = losses[1, i] if u > 0.0 else losses[2, i]
        x = abs(u) / SMOOTHING_DQ
        dry = level * SMOOTHING_DQ * (x + np.log1p(np.exp(-2.0 * x)) - np.log(2.0))
        total += h / share[i] * (0.5 * losses[0, i] * u * u + dry)
    return total


def with_bristles(effects: Sequence[Active]) -> list[Active]:
    """Those that have bristles."""
    return [a for a in effects if isinstance(a.effect, Rubs) and a.effect.bristles(a.values)]


class Bristles:
    """How far the bristles of b effects on n joints are bent: they remember the way.

    Args:
        effects: of which those that have bristles count.
        n: joints.
        period_s: of a step. What is so stiff that a step cannot follow it is taken as softer; at
            1 ms and 3 g m² that is a way below 0.1 mrad for 0.3 N m.

    Attributes:
        effects: those with bristles.
    """

    def __init__(self, effects: Sequence[Active], n: int, period_s: float) -> None:
        self.effects, self._n, self._period_s = with_bristles(effects), n, period_s
        self._joint = [active.joint for active in self.effects]
        self._way = np.array([a.values["s0"] for a in self.effects], dtype=float)
        self._kinds: list[tuple[Rubs, list[int], dict[str, Array]]] = []
        for effect in dict.fromkeys(cast(Rubs, a.effect) for a in self.effects):
            own = [k for k, a in enumerate(self.effects) if a.effect is effect]
            numbers = [self.effects[k].values for k in own]
            values = {key: np.array([x[key] for x in numbers], dtype=float) for key in numbers[0]}
            self._kinds.append((effect, own, values))
        self._most = self._levels(np.zeros(len(self.effects)))
        self._along: tuple[Array, Array] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget how far they are bent: as far as they are where the joint slides as it moves."""
        self._at: Array | None = None
        self._z = np.zeros(len(self.effects))

    def follow(self, t: Array, q: Array, dq: Array) -> None:
        """Remember a recorded motion (m, n) at t (m,) s, from which `settle` starts."""
        if self.effects:
            z, bent = smooth_sign(dq[0, self._joint]), np.empty((len(t), len(self._way)))
            steps = np.diff(q[:, self._joint], axis=0, prepend=q[:1, self._joint])
            bend(steps, self._way, z, bent)
            self._along = t, bent

    def settle(self, t: float, q: Array) -> None:
        """Start at the joint angles q (n,) as the recorded motion left them at t (s)."""
        if self._along is not None:
            times, bent = self._along
            self._at = q.copy()
            self._z = bent[min(int(np.searchsorted(times, t - 1e-9)), len(times) - 1)].copy()

    def torque(self, q: Array, dq: Array, mass: Array, acting: Sequence[Active]) -> Array:
        """Torque (n,) N m at the joint angles q (n,), to which the joints went straight.

        Args:
            q, dq: (n,) rad, rad/s.
            mass: (n, n) kg m².
            acting: effects that do act; the others are bent all the same.
        """
        out = np.zeros(self._n)
        if not self.effects:
            return out
        if self._at is None:
            self._at, self._z = q.copy(), smooth_sign(dq[self._joint])
        light = 1.0 / np.diag(np.linalg.inv(mass))[self._joint]
        way = np.maximum(self._way, self._most * self._period_s**2 / light)
        bend((q - self._at)[None, self._joint], way, self._z, np.empty((1, len(way))))
        self._at = q.copy()
        on = [active in acting for active in self.effects]
        np.add.at(out, self._joint, self._levels(dq[self._joint]) * self._z * on)
        return out

    def _levels(self, dq: Array) -> Array:
        """(b,) N m at which they slide at dq (b,), rad/s."""
        out = np.empty(len(dq))
        for effect, own, values in self._kinds:
            out[own] = effect.level(dq[own], values)
        return out
