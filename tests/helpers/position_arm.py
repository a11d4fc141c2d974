"""Recordings of simulated position-controlled arms, and what is true of their servos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapter.gap.servo import UNITS, ServoGap
from adapter.gap.servo_model import ServoModel
from drivers.files.mcap import Commands, Log
from sim.dynamics import mass_matrix
from sim.hidden.motion import draw_motion
from sim.position_arm import PositionRecording, Servos, draw_servos, record
from sim.truth import Array, Truth, documented


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
        return ServoModel(self.truth.joint_names, *numbers, s.delay_s)

    def true(self, effect: str) -> Array:
        """(n,) SI; of servos that know no command's speed the damping is all one."""
        s = self.servos
        both = np.zeros(self.truth.n) if s.feeds_speed else s.viscous
        return {
            "servo_position_gain": s.kp,
            "servo_velocity_gain": s.kd + both,
            "servo_delay": np.full(self.truth.n, s.delay_s),
            "coulomb_friction": s.coulomb,
            "viscous_friction": s.viscous,
            "motor_inertia": s.armature,
        }[effect]

    @property
    def expected(self) -> set[tuple[str, int]]:
        """(effect, joint from 1) of all that is to be named where nobody documented the servos."""
        alone = [e for e in UNITS if self.servos.feeds_speed or e != "viscous_friction"]
        return {(effect, j + 1) for effect in alone for j in range(self.truth.n)}


def position_arm(seed: int, drawn: Drawn | None = None) -> PositionArm:
    """A Panda whose servos, delay, friction and armature are drawn."""
    drawn, rng, truth = drawn or Drawn(), np.random.default_rng(seed), documented("panda")
    sizes = np.diag(mass_matrix(truth.frames, truth.theta, truth.ready))
    servos = draw_servos(rng, sizes, drawn.feeds_speed, drawn.noise_rad)
    factor = 1.0 + drawn.masses_off * rng.standard_normal((truth.n, 1))
    return PositionArm(truth.with_changes(theta=truth.theta * factor), servos, drawn)


def as_log(recording: PositionRecording, name: str = "arm.mcap") -> Log:
    """In memory."""
    r, none = recording, np.full_like(recording.q, np.nan)
    orders = Commands(r.stamp_ns, np.full_like(r.q_command, np.nan), r.q_command)
    return Log(Path(name), r.joint_names, r.stamp_ns, r.q, none, none, commands=orders)


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
