"""Robots that the adapter knows by name, and robots by file.

Of those known by name there are limits of motion, gains and shapes beyond their URDF: facts with
sources are in the .toml beside it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from adapter.errors import ModelError
from adapter.model import FOLDER, ROBOT_FILES
from adapter.model import robot_names as names
from adapter.model.locking import restricted
from adapter.model.model_file import load_model
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, matrix_from_zxz, vector3
from adapter.model.urdf import read_urdf
from drivers.errors import choices

SAME_TURN, SAME_PLACE_M = 0.2, 0.05  # a learned λ may differ so much from the documented one


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
        return np.maximum(np.sqrt(2.0 * self.deceleration * room) - self.offset, 0.0)


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


def facts_of(model: SelfModel) -> RobotFacts | None:
    """The known arm that a model describes, by its joints and their limits, or else its name."""
    its, limited, named = model.limits, list[RobotFacts](), list[RobotFacts]()
    for robot in [_read(path.stem) for path in sorted(FOLDER.glob("*.toml"))]:
        own, limits = robot.model, robot.model.limits
        if model.tree.floating or model.tree.parent != own.tree.parent:
            continue
        # where its base stands does not matter
        turns = matrix_from_zxz(own.lam[1:, :3]) - matrix_from_zxz(model.lam[1:, :3])
        places = own.lam[1:, 3:] - model.lam[1:, 3:]
        if np.abs(turns).max() < SAME_TURN and np.abs(places).max() < SAME_PLACE_M:
            apart = np.abs([limits.lower - its.lower, limits.upper - its.upper])
            limited += [robot] if (apart < 0.02).all() else []  # rad
            named += [robot] if model.name.lower().startswith(robot.names) else []
    return next(iter(limited or named), None)


def _table(name: str) -> dict[str, Any]:
    table = tomllib.loads((FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
    like = table.pop("like", None)
    return table if like is None else _table(like) | table


@cache
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


def documented(
    name: str | Path,
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
    lock: Mapping[str, float] | None = None,
) -> SelfModel:
    """The documented model of a robot: by name, from a .urdf file or from a model file (.json).

    `effects.robots.read_robot` takes an MJCF, too.

    Args:
        name: one of `names()`, or the path of a file, or of a run's folder.
        joints: which joints are wanted, all where None; the others are locked.
        floating: whether the base is free.
        gravity: (3,) acceleration of gravity in base axes, m/s²; the file's own where None.
        lock: values of joints to be locked, rad, and m of prismatic ones (see `urdf.read_urdf`).

    Raises:
        ModelError: unknown name (names the choices), or a file that can't be read.
    """
    text, of_run = str(name), Path(name) / "model.json"
    if text not in names() and of_run.is_file():
        text = str(of_run)
    if text in names():
        return read_urdf(FOLDER / f"{text}.urdf", joints, floating, gravity, lock)
    suffix = Path(text).suffix.lower()
    if suffix not in (".urdf", ".json"):
        raise ModelError(f"no robot '{text}'; {choices(text, names(), ROBOT_FILES)}")
    if suffix == ".urdf":
        return read_urdf(text, joints, floating, gravity, lock)
    model = load_model(text)
    if model.source is None and model.name in names():
        # its own file is older than that of the robot that it is
        known = documented(model.name)
        same = known.tree.joint_names == model.tree.joint_names
        if same and np.allclose(known.lam, model.lam, rtol=0.0, atol=1e-12):
            model = replace(model, source=known.source)
    model = restricted(model.with_base(floating), joints, lock or {})
    return model if gravity is None else replace(model, gravity=vector3(gravity))
