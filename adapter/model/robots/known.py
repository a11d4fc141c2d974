"""What is known of an arm beyond its URDF: limits of motion, gains, shapes. Facts with sources are
in the .toml beside its .urdf."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from adapter.model.robot_names import FOLDER
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, matrix_from_zxz
from adapter.model.urdf import read_urdf

SAME_TURN, SAME_PLACE_M = 0.2, 0.05  # a learned λ may differ so much from the documented one
SAME_LIMIT = 0.02  # rad


@dataclass(frozen=True)
class SpeedByPosition:
    """How fast a joint may go towards the end of its range, (n,) each; see `fr3.toml`.

    Attributes:
        deceleration: rad/s²; offset: rad/s; lower, upper: rad.
    """

    deceleration: Array
    offset: Array
    lower: Array
    upper: Array

    def between(self, low: Array, high: Array) -> Array:
        """Speed (n,) rad/s that is allowed in both directions everywhere from low to high (n,)."""
        room = np.maximum(np.minimum(self.upper - high, low - self.lower), 0.0)
        speed: Array = np.maximum(np.sqrt(2.0 * self.deceleration * room) - self.offset, 0.0)
        return speed


@dataclass(frozen=True)
class RobotFacts:
    """An arm that is known by name; arrays (n,).

    Attributes:
        name: of its model here.
        names: how files call it, at the beginning of the name.
        acceleration, jerk, torque_rate: limits, rad/s², rad/s³, N m/s.
        stiffness, damping: of the feedback, N m/rad, N m s/rad.
        capsules: by number of the link (0 the base) rows [from, to, radius] (7,) in its frame, m.
        speed_by_position: None where the velocity limit holds everywhere.
        model: its documented model.
    """

    name: str
    names: tuple[str, ...]
    acceleration: Array
    jerk: Array
    torque_rate: Array
    stiffness: Array
    damping: Array
    capsules: dict[int, Array]
    speed_by_position: SpeedByPosition | None
    model: SelfModel

    def has_the_body_of(self, model: SelfModel) -> bool:
        """Whether a model has the same joints; where its base stands does not matter."""
        own = self.model
        if model.tree.floating or model.tree.parent != own.tree.parent:
            return False
        turns = matrix_from_zxz(own.lam[1:, :3]) - matrix_from_zxz(model.lam[1:, :3])
        places = own.lam[1:, 3:] - model.lam[1:, 3:]
        return bool(np.abs(turns).max() < SAME_TURN and np.abs(places).max() < SAME_PLACE_M)


@cache
def known_robots() -> tuple[RobotFacts, ...]:
    """All arms that are known by name."""
    return tuple(_read(path.stem) for path in sorted(FOLDER.glob("*.toml")))


def facts_of(model: SelfModel) -> RobotFacts | None:
    """The known arm that a model describes, by its joints and their limits, or else its name."""
    same = [robot for robot in known_robots() if robot.has_the_body_of(model)]
    its, limited = model.limits, []
    for robot in same:
        own = robot.model.limits
        apart = np.abs([own.lower - its.lower, own.upper - its.upper])
        limited += [robot] if (apart < SAME_LIMIT).all() else []
    named = [robot for robot in same if model.name.lower().startswith(robot.names)]
    return next(iter(limited or named), None)


def _table(name: str) -> dict[str, Any]:
    table = tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    like = table.pop("like", None)
    return table if like is None else _table(like) | table


def _read(name: str) -> RobotFacts:
    table = _table(name)
    names, capsules = tuple(table.pop("names")), table.pop("capsules")
    by_position = table.pop("speed_by_position", None)
    speed = by_position and SpeedByPosition(**{k: np.array(v) for k, v in by_position.items()})
    return RobotFacts(
        name=name,
        names=names,
        capsules={int(link): np.array(rows) for link, rows in capsules.items()},
        speed_by_position=speed,
        model=read_urdf(FOLDER / f"{name}.urdf"),
        **{key: np.array(values) for key, values in table.items()},
    )
