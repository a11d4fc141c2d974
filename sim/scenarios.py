"""Scenarios: a truth, what the sensors add and what they measure, by name and seed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.effects import Effect, payload, per_joint
from sim.engine import PERIOD_S, SUBSTEPS
from sim.noise import levels_of
from sim.noise_levels import NoiseLevels
from sim.options import ROBOTS, SCENARIOS, check
from sim.plant import Plant
from sim.sensors import Imus
from sim.truth import (
    FLANGE_M,
    Truth,
    direction,
    documented,
    facts_of,
    turn,
    turn_about,
    wrong_bodies,
)

FORMAT, VERSION = "panda-adapter/truth", 2
STAND_OFF_M = 0.05  # m, its centre is so far off the flange ...
SIDE_STEP_M = 0.02  # m, ... and so far from the axis of joint 7
BALL_AT = np.array([SIDE_STEP_M, 0.0, FLANGE_M + STAND_OFF_M])


@dataclass(frozen=True, eq=False)
class Scenario:
    """A simulated arm as it is started.

    Attributes:
        name: of the scenario.
        seed: decides truth and noise.
        truth: the arm.
        noise: what the sensors add.
        links: whether link motion is measured.
        imus: links with a sensor glued on, anyhow, which are then all that tells of link motion.
    """

    name: str
    seed: int
    truth: Truth
    noise: NoiseLevels
    links: bool
    imus: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Imus(self.truth.link_names, self.imus, self.seed, PERIOD_S)

    def plant(self, substeps: int = SUBSTEPS) -> Plant:
        """A fresh arm at t = 0, at rest at the truth's own posture."""
        links = self.imus or self.links
        return Plant(self.truth, self.seed, self.noise, links, substeps=substeps)

    def as_dict(self) -> dict[str, Any]:
        """What a truth file holds."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "scenario": self.name,
            "seed": self.seed,
            **self.truth.as_dict(),
            "links_measured": self.links,
            "imus": list(self.imus),
            "noise": asdict(self.noise),
        }

    def write_truth(self, path: Path | str) -> None:
        """Write the truth as JSON."""
        Path(path).write_text(json.dumps(self.as_dict(), indent=1) + "\n", "utf-8")


def nominal(rng: np.random.Generator, robot: str) -> Truth:
    """The documented arm."""
    return documented(robot)


def bent_link(
    rng: np.random.Generator, robot: str, angle_deg: float = 5.0, offset_m: float = 0.02
) -> Truth:
    """Every joint frame turned by up to `angle_deg` and shifted by up to `offset_m`."""
    arm = documented(robot)
    angles = np.radians(angle_deg) * rng.random(arm.n)
    lengths = offset_m * rng.random(arm.n)
    turns = np.array([turn_about(direction(rng), angle) for angle in angles])
    shifts = np.array([length * direction(rng) for length in lengths])
    return arm.with_changes(R=arm.R @ turns, p=arm.p + shifts)


def payload_at_20s(
    rng: np.random.Generator, robot: str, mass: float = 1.0, t_s: float = 20.0
) -> Truth:
    """A ball of `mass` kg at the flange after `t_s`."""
    ball = payload(mass, BALL_AT, 0.4 * mass * 0.04**2 * np.eye(3), t_s)
    return documented(robot).with_changes(effects=(ball,))


def friction(rng: np.random.Generator, robot: str) -> Truth:
    """The documented arm with the friction published for it."""
    losses = facts_of(robot)["friction"]
    viscous = per_joint("viscous_friction", "Fv", losses["Fv"])
    return documented(robot).with_changes(
        effects=viscous + per_joint("coulomb_friction", "Fc", losses["Fc"])
    )


def real_drives(rng: np.random.Generator, robot: str, spread: float = 0.0) -> Truth:
    """The same arm with friction that sticks, and the inertia of its motors.

    Without the one it creeps where a force controller holds it at rest by its noisy sensors, and
    without the other its light wrist cannot be controlled. Each level of friction is the published
    one times `exp(spread)` or less, down to `exp(-spread)` of it.
    """
    facts = facts_of(robot)
    losses = facts["friction"]
    viscous, sticking = (
        losses[key] * np.exp(rng.uniform(-spread, spread, len(losses[key]))) for key in ("Fv", "Fc")
    )
    effects = per_joint("viscous_friction", "Fv", viscous)
    effects += per_joint("motor_inertia", "B", facts["motors"]["B"])
    effects += tuple(
        Effect("bristle_friction", (j,), {"Fc": level, "s0": losses["s0"]})
        for j, level in enumerate(sticking.tolist(), 1)
    )
    return documented(robot).with_changes(effects=effects)


def as_built(
    rng: np.random.Generator, robot: str, mass: float = 1.0, t_s: float = 25.0, error: float = 0.05
) -> Truth:
    """A unit that differs from its documentation as real ones do, and takes a ball half way.

    Every inertial number is off by `error` of itself (rms), friction by up to half from what is
    published for another unit, and the torque sensor of a large joint has its zero up to 1 N m off.
    """
    arm = real_drives(rng, robot, spread=np.log(1.5))
    zero = per_joint("torque_offset", "o", rng.uniform(0.3, 1.0) * np.eye(arm.n)[rng.integers(4)])
    (ball,) = payload_at_20s(rng, robot, mass, t_s).effects
    bodies = wrong_bodies(arm.theta, error, rng)
    return arm.with_changes(theta=bodies, effects=(*arm.effects, *zero, ball))


def wall_mounted(rng: np.random.Generator, robot: str) -> Truth:
    """The documented arm on a wall: the base's z axis is level, its x axis points down."""
    arm = documented(robot)
    return arm.with_changes(gravity=turn(1, np.pi / 2).T @ arm.gravity)


# The levels are those of a log in motion, where gears add to the noise. Chosen: with all of it at
# rest a force controller, which takes its zero there, drifts away against friction.
LEVELS = {name: {"tau_at_rest": 0.2} for name in ("real_drives", "as_built")}
DRAWN_BY: dict[str, Callable[..., Truth]] = {
    "nominal": nominal,
    "bent_link": bent_link,
    "payload_at_20s": payload_at_20s,
    "friction": friction,
    "real_drives": real_drives,
    "as_built": as_built,
    "wall_mounted": wall_mounted,
}


def build(name: str, seed: int = 0, **options: Any) -> Scenario:
    """A scenario by name.

    Args:
        name: one of `options.SCENARIOS`.
        seed: decides truth and noise.
        options: `robot` ("panda" or "fr3"), `noise` ("real" or "none"), `links` (bool: measure
            link motion or not), `levels` (a mapping of single noise levels to change, see
            `NoiseLevels`), `imus` (names of links with a sensor glued on), `trouble` (see
            `in_trouble`), and those of the scenario: `angle_deg`, `offset_m` of bent_link, `mass`
            (kg), `t_s` of payload_at_20s.

    Raises:
        ValueError: unknown name, option or level, or a value out of range; with the choices.
    """
    numbers = check(name, options)
    rng, robot = np.random.default_rng([seed, 1 << 32]), options.get("robot", ROBOTS[0])
    truth = DRAWN_BY[name](rng, robot, **numbers)
    return Scenario(
        name,
        seed,
        in_trouble(truth, options.get("trouble", {})),
        levels_of(
            options.get("noise", "real"), **{**LEVELS.get(name, {}), **options.get("levels", {})}
        ),
        options.get("links", SCENARIOS[name].links),
        tuple(options.get("imus", ())),
    )


def in_trouble(truth: Truth, trouble: dict[str, Any]) -> Truth:
    """The same arm with something in its way.

    Args:
        truth: the arm.
        trouble: `held` (numbers of joints) held from `t_s` on, and pushed with `push` (N m) by a
            spring of `k` (N m/rad), `wall` (m ahead of the hand) standing there from `t_s` on,
            `floor` (its height in m, base axes), `load` (kg at the flange) carried up to `t_s`.
    """
    effects, since = list(truth.effects), (float(trouble.get("t_s", 0.0)), None)
    if "held" in trouble:
        said: dict[str, Any] = {key: float(trouble[key]) for key in ("push", "k") if key in trouble}
        effects.append(Effect("x_held_joint", tuple(trouble["held"]), said, since))
    if "wall" in trouble:
        effects.append(Effect("x_wall", (), {"gap": float(trouble["wall"])}, since))
    if "floor" in trouble:
        effects.append(Effect("x_floor", (), {"height": float(trouble["floor"])}, since))
    if "load" in trouble:
        load = payload(float(trouble["load"]), BALL_AT)
        effects.append(Effect(load.name, (), load.parameters, (-1.0, since[0])))
    return truth.with_changes(effects=tuple(effects))
