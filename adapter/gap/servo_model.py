"""What the servos of a position-controlled arm are, their file, and the motion they make."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adapter.errors import ModelError
from adapter.gap import servo_kernels as col
from adapter.gap.servo_kernels import NO_GROUND, SLIP, Body, Ground, follow_together
from adapter.gap.servo_signals import Track
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.kernels import base_at_rest
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import Commands, Log

KEYS = ("position_gain", "velocity_gain", "coulomb", "viscous", "armature")
# keys that a joint need not have, and what they are where there is none
OTHERS = {"stiction": 0.0, "torque_limit": np.inf, "dead_band": 0.0, "backlash": 0.0, "slip": SLIP}


@dataclass(frozen=True, eq=False)
class ServoModel:
    """Servos of an arm, (n,) each.

    Attributes:
        joint_names: of the arm.
        position_gain, velocity_gain: N m/rad, N m s/rad. An ideal servo, which is where a command
            is, has an infinite position gain.
        coulomb, viscous: friction, N m and N m s/rad; armature: kg m².
        delay_s: from a command's stamp until it acts.
        feeds_speed: (n,) whether the velocity gain acts on the command's speed less the joint's.
            Where it does not, velocity gain and viscous friction do the same: their sum counts.
        ground: what the hand comes down on, if anything.
        stiction: N m, by which breaking a joint loose takes more than Coulomb friction; it falls
            in a line to nothing at `slip`, rad/s.
        torque_limit: N m, of what both gains ask for; dead_band: rad, of an error that drives
            nothing; backlash: rad, of the gear, from end to end, where servos steer by their
            motors and readings are of the links.
    """

    joint_names: tuple[str, ...]
    position_gain: Array
    velocity_gain: Array
    coulomb: Array
    viscous: Array
    armature: Array
    feeds_speed: NDArray[np.bool_]
    delay_s: float = 0.0
    ground: Ground = NO_GROUND
    stiction: Array = field(default_factory=lambda: np.zeros(()))
    torque_limit: Array = field(default_factory=lambda: np.array(np.inf))
    dead_band: Array = field(default_factory=lambda: np.zeros(()))
    backlash: Array = field(default_factory=lambda: np.zeros(()))
    slip: Array = field(default_factory=lambda: np.array(SLIP))

    def __post_init__(self) -> None:
        for key in OTHERS:  # one number for all joints, too
            each = np.broadcast_to(getattr(self, key), len(self.joint_names))
            object.__setattr__(self, key, np.array(each, dtype=float))

    @classmethod
    def ideal(cls, joint_names: tuple[str, ...]) -> ServoModel:
        """Servos that are where their commands are."""
        nothing = np.zeros(len(joint_names))
        never, endless = np.zeros(len(joint_names), dtype=bool), np.full(len(joint_names), np.inf)
        return cls(joint_names, endless, nothing, nothing, nothing, nothing, never)

    @property
    def is_ideal(self) -> bool:
        """Whether any joint simply is where it is told to be."""
        return bool(np.isinf(self.position_gain).any())

    def table(self) -> Array:
        """(n, 12) as the compiled simulation takes it."""
        x = np.zeros((len(self.joint_names), col.WITHIN + 1))
        x[:, col.A] = 1.0 / self.position_gain
        x[:, col.LEAD] = x[:, col.A] * self.velocity_gain * self.feeds_speed
        x[:, col.DAMPING] = x[:, col.A] * (self.velocity_gain + self.viscous)
        x[:, col.INERTIA] = x[:, col.A] * self.armature
        x[:, col.RUBS] = x[:, col.A] * self.coulomb
        x[:, col.STICKS] = x[:, col.A] * self.stiction
        x[:, col.DELAY], x[:, col.SLIPS] = self.delay_s, self.slip
        limited = np.isfinite(self.torque_limit)
        x[limited, col.TIGHT] = self.position_gain[limited] / self.torque_limit[limited]
        x[:, col.DEAD], x[:, col.PLAY] = self.dead_band, 0.5 * self.backlash
        x[:, col.WITHIN] = x[:, col.A] * self.velocity_gain
        return x

    def follow(self, track: Track, arm: RigidArm) -> Array:
        """(m, n) rad where the arm is, one row for each step of the track, by commands alone."""
        if self.is_ideal:
            return track.commanded(self.delay_s)
        x = self.table()
        goal = track.goal(x[:, col.LEAD], self.delay_s)
        q = np.empty_like(goal[0])
        body = Body(arm.frames, arm.theta, base_at_rest(arm.gravity), self.ground)
        follow_together(x, goal, body, track.start, track.step_s, q)
        return q

    def motion(self, model: SelfModel, time_s: ArrayLike, commands: ArrayLike) -> Array:
        """(m, n) where an arm goes under commands (m, n), from rest at the first of them.

        Args:
            time_s: (m,) s, rising, of the commands, each held until the next.
        """
        goal, stamp_ns = np.asarray(commands, float), (1e9 * np.asarray(time_s)).astype(np.int64)
        rests, unknown = np.tile(goal[:1], (len(goal), 1)), np.full_like(goal, np.nan)
        orders, signals = Commands(stamp_ns, unknown, goal), (rests, unknown, unknown)
        log = Log(Path("commands"), self.joint_names, stamp_ns, *signals, commands=orders)
        track = Track.of(log)
        return np.asarray(rests - track.left(self.follow(track, RigidArm.of(model))))

    def tracking_error(self, track: Track, arm: RigidArm) -> Array:
        """(n,) rad, rms of the measured positions less the simulated ones."""
        left = track.left(self.follow(track, arm))
        return np.asarray(np.sqrt(np.mean(left[track.judged] ** 2, axis=0)))

    def save(self, path: Path) -> None:
        """As TOML, read by `read_servos`."""
        lines = [
            "# Servos of a position-controlled arm: N m/rad, N m s/rad, N m, N m s/rad, kg m2.",
            f"delay_s = {self.delay_s:.6g}",
        ]
        for j, name in enumerate(self.joint_names):
            quoted = name.replace("\\", "\\\\").replace('"', '\\"')
            lines += ["", "[[joint]]", f'name = "{quoted}"']
            own = {key: float(getattr(self, key)[j]) for key in (*KEYS, *OTHERS)}
            lines += [f"{key} = {x:.6g}" for key, x in own.items() if x != OTHERS.get(key)]
            lines.append(f"feeds_speed = {str(bool(self.feeds_speed[j])).lower()}")
        if facts := ground_facts(self.ground, self.joint_names):
            told = "what the hand comes down on: behind which joint, where in that link's frame"
            lines += ["", f"# {told}, m, N/m", "[ground]"]
            lines += [f"{key} = {json.dumps(value)}" for key, value in facts.items()]
        path.write_text("\n".join(lines) + "\n", "utf-8")


def ground_facts(ground: Ground, joint_names: Sequence[str]) -> dict[str, Any]:
    """A ground as it stands in files; empty where there is none."""
    if ground.root == 0.0:
        return {}
    return {
        "joint": joint_names[ground.link],
        "point": ground.point.tolist(),
        "up": ground.up.tolist(),
        "height": ground.height,
        "stiffness": ground.root**2,
        "friction": ground.rubs,
    }


def read_servos(path: str | Path, joint_names: tuple[str, ...]) -> ServoModel:
    """Servos from a file, in the arm's order of joints. Raises ModelError with what is wrong."""
    path = Path(path)
    try:
        facts = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ModelError(f"{path}: is not TOML: {error}") from error
    joints = facts.get("joint")
    if not isinstance(joints, list) or not all(isinstance(j, dict) for j in joints):
        raise ModelError(f"{path}: needs a [[joint]] for each joint, with name and {KEYS[0]}")
    strange = [key for key in facts if key not in ("delay_s", "joint", "ground")]
    strange += [k for j in joints for k in j if k not in (*KEYS, *OTHERS, "name", "feeds_speed")]
    if strange:
        choices = ", ".join(("delay_s", "ground", "name", *KEYS, *OTHERS, "feeds_speed"))
        raise ModelError(f"{path}: does not know {', '.join(strange)}; have: {choices}")
    told = {j.get("name"): j for j in joints}
    missing = [name for name in joint_names if name not in told]
    if missing:
        have = ", ".join(map(str, told))
        raise ModelError(f"{path}: lacks the joints {', '.join(missing)}; it has {have}")
    servos = ServoModel.ideal(joint_names)
    rows = [told[name] for name in joint_names]
    usual: dict[str, float | None] = {KEYS[0]: None, **dict.fromkeys(KEYS[1:], 0.0), **OTHERS}
    found: dict[str, Any] = {
        key: np.array([_number(path, row, key, x) for row in rows]) for key, x in usual.items()
    }
    found["feeds_speed"] = np.array([bool(row.get("feeds_speed", False)) for row in rows])
    if "ground" in facts:
        found["ground"] = _ground(path, facts["ground"], joint_names)
    return replace(servos, delay_s=_number(path, facts, "delay_s", 0.0), **found)


def _ground(path: Path, facts: Any, joint_names: tuple[str, ...]) -> Ground:
    try:
        link = joint_names.index(facts["joint"])
        height, stiffness = float(facts["height"]), float(facts["stiffness"])
        rubs = float(facts.get("friction", 0.0))
        point, up = (np.array(facts[key], dtype=float).reshape(3) for key in ("point", "up"))
        finite = np.all(np.isfinite([*point, *up, height, stiffness, rubs]))
        if not finite or stiffness <= 0.0 or rubs < 0.0:
            raise ValueError("a number is none of a ground")
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(
            f"{path}: [ground] needs the joint (one of {', '.join(joint_names)}), point and up of "
            f"three numbers, height and stiffness, perhaps friction: {error}"
        ) from error
    return Ground(link, point, up, height, float(np.sqrt(stiffness)), rubs)


def _number(path: Path, row: Mapping[str, Any], key: str, usual: float | None) -> float:
    if key not in row and usual is not None:
        return usual
    value = row.get(key)
    if not isinstance(value, int | float) or not np.isfinite(value) or value < 0.0:
        raise ModelError(f"{path}: {key} must be a number, 0 or more, got {value!r}")
    if usual != 0.0 and value == 0.0:
        raise ModelError(f"{path}: {key} must be more than 0")
    return float(value)
