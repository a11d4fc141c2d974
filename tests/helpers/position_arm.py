"""A position-controlled arm: servos on the joints of a rigid arm, with encoders and nothing else.

Each servo holds the last position command that has reached it and drives its joint by
kp (q_cmd - q) + kd (dq_cmd - dq). Where it is told no speed, dq_cmd is zero, or, in servos that
feed the speed forward, the rate of the last two commands. Commands take `delay_s` to reach it.
Coulomb friction holds a joint at rest (that of `sim.effects` lets it creep, which a servo's steady
error would show), so that the arm is moved by the simulator's own equations of rigid bodies.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.gap.servo_model import ServoModel
from adapter.gap.servo_result import EFFECTS, ServoGap
from drivers.files.mcap import Commands, Log, McapWriter
from sim.dynamics import Frames, compiled, end_effector, mass_matrix, torques
from sim.truth import Array, Truth, documented
from tests.hidden.motion import draw_motion

TICK_S, STEPS = 1e-3, 8  # commands act at ticks; steps of a tick
SETTLE_S = 1.0  # at the first command before the recording begins


@dataclass(frozen=True, eq=False)
class Servos:
    """What is true of the servos, (n,) each.

    Attributes:
        kp, kd: position and velocity gain, N m/rad and N m s/rad.
        coulomb, viscous: friction, N m and N m s/rad; armature: the motor's inertia, kg m².
        delay_s: from a command's stamp until it acts, whole milliseconds.
        feeds_speed: the servos derive the command's speed and feed it forward.
        noise_rad: standard deviation of an encoder's reading.
        table: what the hand comes down on: where on the last link (m), its height over the base's
            origin (m), its stiffness (N/m), none where that is zero, and coefficient of friction.
        stiction: N m, by which breaking loose takes more than Coulomb friction; slip: rad/s, at
            which an e-th of it is left (Stribeck).
        limit: N m, of what both gains ask for; dead: rad, of an error that drives nothing;
            backlash: rad, of the gear, from end to end; servos steer by their motors, and readings
            are of the links.
    """

    kp: Array
    kd: Array
    coulomb: Array
    viscous: Array
    armature: Array
    delay_s: float = 0.003
    feeds_speed: bool = True
    noise_rad: float = 2e-5
    table: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    stiction: Array = field(default_factory=lambda: np.zeros(7))
    slip: Array = field(default_factory=lambda: np.full(7, 0.1))
    limit: Array = field(default_factory=lambda: np.full(7, np.inf))
    dead: Array = field(default_factory=lambda: np.zeros(7))
    backlash: Array = field(default_factory=lambda: np.zeros(7))


class Body(NamedTuple):
    """The rigid arm as compiled code takes it, see `sim.dynamics.torques`."""

    frames: Frames
    theta: Array
    base: Array
    table: Array


@dataclass(frozen=True, eq=False)
class PositionRecording:
    """What a recording of such an arm holds.

    Attributes:
        joint_names: order of the columns.
        stamp_ns: (m,) of encoders and commands; q, q_command: (m, n) rad.
    """

    joint_names: tuple[str, ...]
    stamp_ns: NDArray[np.int64]
    q: Array
    q_command: Array

    def write(self, path: Path) -> None:
        """As an MCAP file: joint states and commands, positions only."""
        with McapWriter(path, self.joint_names, overwrite=True) as writer:
            rows = zip(self.stamp_ns.tolist(), self.q, self.q_command, strict=True)
            for stamp_ns, q, command in rows:
                writer.write_position(stamp_ns, q)
                writer.write_position_command(stamp_ns, command)


def record(
    truth: Truth, servos: Servos, commands: Array, period_s: float = 2e-3, seed: int = 0
) -> PositionRecording:
    """Let the arm follow position commands (m, n) rad, one each period (whole milliseconds).

    The arm starts at rest at the first command and settles there before the recording begins.

    Args:
        truth: the rigid arm; servos: on its joints.
        seed: of the encoders' noise.
    """
    every, late = round(period_s / TICK_S), round(servos.delay_s / TICK_S)
    body = Body(truth.frames, truth.theta, truth.base, np.array(servos.table))
    s = servos
    limits = s.limit, s.dead, s.backlash, s.stiction, s.slip
    joints = np.array([s.kp, s.kd, s.coulomb, s.viscous, s.armature, *limits], float)
    at, q = np.zeros((5, truth.n)), np.empty_like(commands)
    at[0] = at[3] = commands[0]
    for tick in range(-round(SETTLE_S / TICK_S), len(commands) * every):
        if tick >= 0 and tick % every == 0:
            q[tick // every] = at[0]
        k = max((tick - late) // every, 0)
        speed = (commands[k] - commands[max(k - 1, 0)]) / period_s * servos.feeds_speed
        step = move_with_backlash if s.backlash.any() else move
        step(body, joints, commands[k], speed, at)
    q += servos.noise_rad * np.random.default_rng(seed).standard_normal(q.shape)
    stamp_ns = (np.arange(len(q)) * round(1e9 * period_s)).astype(np.int64)
    return PositionRecording(truth.joint_names, stamp_ns, q, commands)


@compiled
def driven(joints: Array, error: Array, slower: Array) -> Array:
    """(n,) N m that servos ask of their motors, at errors of position and speed."""
    kp, kd, limit, dead = joints[0], joints[1], joints[5], joints[6]
    asked = kp * error * (np.abs(error) > dead) + kd * slower
    return np.minimum(np.maximum(asked, -limit), limit)


@compiled
def dry_friction(joints: Array, dq: Array) -> Array:
    """(n,) N m at speeds (n,)."""
    return joints[2] + joints[8] * np.exp(-((dq / joints[9]) ** 2))


@compiled
def move_with_backlash(body: Body, joints: Array, goal: Array, speed: Array, at: Array) -> None:
    """As `move`, each motor behind a gap, whose ends are stiff springs with some damping.

    Args:
        at: (5, n) q, dq of the links, ddq (not used), q, dq of the motors, changed.
    """
    viscous, armature, backlash = joints[3], joints[4], joints[7]
    n, h, still = len(goal), TICK_S / STEPS / 4, np.zeros(len(goal))
    q, dq, _, motor, fast = at
    inertia = mass_matrix(body.frames, body.theta, q)
    stiff = np.minimum(np.diag(inertia), armature) * (0.3 / h) ** 2
    for _ in range(4 * STEPS):
        wound, slip = motor - q, fast - dq
        into = np.sign(wound) * np.maximum(np.abs(wound) - 0.5 * backlash, 0.0)
        carried = (stiff * into + 0.6 * stiff * h * slip) * (into != 0.0)
        drive = driven(joints, goal - motor, speed - fast) - viscous * fast - carried
        way, rubs = np.sign(fast), dry_friction(joints, fast)
        for j in range(n):
            if way[j] == 0.0 and abs(drive[j]) > rubs[j]:
                way[j] = np.sign(drive[j])
        new = fast + h * (drive - way * rubs) / armature * (way != 0.0)
        fast[:] = new * (new * way > 0.0)
        motor += h * fast
        rigid = torques(body.frames, body.theta, body.base, q, dq, still)
        dq += h * np.linalg.solve(inertia, carried - rigid)
        q += h * dq


@compiled
def move(body: Body, joints: Array, goal: Array, speed: Array, at: Array) -> None:
    """One millisecond under one command: small steps, forces as at their middles.

    A joint at rest stays there as long as Coulomb friction can hold it against all else, and one
    whose velocity would change its sign comes to rest.

    Args:
        joints: (10, n) of `Servos`: kp, kd, coulomb, viscous, armature, limit, dead, backlash,
            stiction, slip.
        goal, speed: (n,) rad, rad/s; at: (5, n) q, dq and the last step's ddq, changed, and two
            rows for motors with backlash.
    """
    viscous, armature = joints[3:5]
    n, h, still = len(goal), TICK_S / STEPS, np.zeros(len(goal))
    q, dq, last, _, _ = at
    tip = np.eye(4)
    tip[:3, 3] = body.table[:3]
    inertia = mass_matrix(body.frames, body.theta, q)
    for j in range(n):
        inertia[j, j] += armature[j]
    for _ in range(STEPS):
        middle = dq + 0.5 * h * last
        midway = q + 0.5 * h * dq
        drive = driven(joints, goal - midway, speed - middle) - viscous * middle
        drive -= torques(body.frames, body.theta, body.base, midway, middle, still)
        if body.table[4] > 0.0:
            pose, J = end_effector(body.frames, midway, tip)
            force = body.table[4] * max(body.table[3] - pose[2, 3], 0.0)
            along = J[:2] @ middle
            fast = np.hypot(along[0], along[1])
            drag = body.table[5] * force * np.tanh(fast / 2e-3) / max(fast, 1e-9)
            drive += J[2] * force - drag * (along @ J[:2])
        way, rests, rubs = np.sign(dq), dq == 0.0, dry_friction(joints, middle * (dq != 0.0))
        ddq = np.zeros(n)
        for _ in range(2 * n):  # one joint is let go or held at a time
            A, b = inertia.copy(), drive - way * rubs
            for j in range(n):
                if rests[j]:
                    A[j, :], A[:, j], A[j, j], b[j] = 0.0, 0.0, 1.0, 0.0
            ddq = np.linalg.solve(A, b)
            needed = np.abs(drive - inertia @ ddq) - rubs
            worst, k = 0.0, -1
            for j in range(n):
                if rests[j] and needed[j] > worst:
                    worst, k = needed[j], j
            if k < 0:
                break
            rests[k], way[k] = False, np.sign((drive - inertia @ ddq)[k])
        new = dq + h * ddq
        for j in range(n):
            if dq[j] * new[j] < 0.0:
                new[j] = 0.0
        q += 0.5 * h * (dq + new)
        last[:] = ddq * (new != 0.0)
        dq[:] = new


@dataclass(frozen=True)
class Drawn:
    """How a recording is drawn.

    Attributes:
        seconds: of motion; period_s: of readings and commands; noise_rad: of the encoders.
        feeds_speed: the servos know the command's speed; masses_off: share by which bodies are
            other than documented, one standard deviation.
    """

    seconds: float = 10.0
    period_s: float = 2e-3
    noise_rad: float = 2e-5
    feeds_speed: bool = True
    masses_off: float = 0.0


@dataclass(frozen=True, eq=False)
class PositionArm:
    """A simulated Panda with hidden servos."""

    truth: Truth
    servos: Servos
    drawn: Drawn

    def moved(self, kind: str, seed: int) -> PositionRecording:
        """A recording of one kind of motion."""
        rng, drawn = np.random.default_rng(seed), self.drawn
        motion = draw_motion(rng, self.truth.limits, self.truth.ready, kind)
        commands = motion.at(np.arange(0.0, drawn.seconds, drawn.period_s))[0]
        return record(self.truth, self.servos, commands, drawn.period_s, seed)

    @property
    def documentation(self) -> ServoModel:
        """True servos as their maker would write them down."""
        s, n = self.servos, self.truth.n
        numbers = (s.kp, s.kd, s.coulomb, s.viscous, s.armature, np.full(n, s.feeds_speed))
        model = ServoModel(self.truth.joint_names, *numbers, s.delay_s)
        model = replace(model, stiction=s.stiction)
        return replace(model, torque_limit=s.limit, dead_band=s.dead, backlash=s.backlash)

    def true(self, effect: str) -> Array:
        """(n,) SI; of servos that know no command's speed the damping is all one."""
        s = self.servos
        both = np.zeros(self.truth.n) if s.feeds_speed else s.viscous
        return {
            "servo_position_gain": s.kp,
            "servo_velocity_gain": s.kd + both,
            "servo_delay": np.full(self.truth.n, s.delay_s),
            "coulomb_friction": s.coulomb,
            "static_friction": s.stiction,
            "viscous_friction": s.viscous,
            "motor_inertia": s.armature,
            "servo_torque_limit": s.limit,
            "servo_dead_band": s.dead,
            "backlash": s.backlash,
        }[effect]

    @property
    def expected(self) -> set[tuple[str, int]]:
        """(effect, joint from 1) of all that is to be named where nobody documented the servos."""
        alone = [e for e in EFFECTS if self.servos.feeds_speed or e != "viscous_friction"]
        none = {"servo_torque_limit": np.inf}
        return {
            (effect, j + 1)
            for effect in alone
            for j in range(self.truth.n)
            if self.true(effect)[j] != none.get(effect, 0.0)
        }


def position_arm(seed: int, drawn: Drawn | None = None) -> PositionArm:
    """A Panda whose servos, delay, friction and armature are drawn.

    Bandwidths of 5 to 10 Hz, damping of 0.6 to 1, friction as of a geared joint, delays of 1 to
    8 ms.
    """
    drawn, rng, truth = drawn or Drawn(), np.random.default_rng(seed), documented("panda")
    sizes, n = np.diag(mass_matrix(truth.frames, truth.theta, truth.ready)), truth.n
    armature = sizes * rng.uniform(0.3, 1.0, n)
    moved = sizes + armature
    omega = 2.0 * np.pi * rng.uniform(5.0, 10.0, n)
    kp = moved * omega**2
    viscous = moved * omega * rng.uniform(0.1, 0.4, n)
    kd = 2.0 * rng.uniform(0.6, 1.0, n) * moved * omega - viscous
    coulomb = kp * rng.uniform(1e-3, 5e-3, n)
    told = TICK_S * int(rng.integers(1, 9)), drawn.feeds_speed, drawn.noise_rad
    servos = Servos(kp, kd, coulomb, viscous, armature, *told)
    factor = 1.0 + drawn.masses_off * rng.standard_normal((n, 1))
    return PositionArm(truth.with_changes(theta=truth.theta * factor), servos, drawn)


def as_log(recording: PositionRecording) -> Log:
    """In memory."""
    r, none = recording, np.full_like(recording.q, np.nan)
    orders = Commands(r.stamp_ns, np.full_like(r.q_command, np.nan), r.q_command)
    return Log(Path("arm.mcap"), r.joint_names, r.stamp_ns, r.q, none, none, commands=orders)


def named(gap: ServoGap) -> set[tuple[str, int]]:
    """(effect, joint from 1) of the findings."""
    return {(f.effect, j) for f in gap.findings for j in f.joints}


def errors(gap: ServoGap, arm: PositionArm) -> dict[str, Array]:
    """Relative errors of the findings' values, by effect."""
    found = {}
    for f in gap.findings:
        true = arm.true(f.effect)[np.array(f.joints) - 1]
        found[f.effect] = np.array(f.values) / true - 1.0
    return found
