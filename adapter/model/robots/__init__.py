"""Robots that the adapter knows by name, and robots by file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from adapter.errors import ModelError
from adapter.model.locking import restricted
from adapter.model.model_file import load_model
from adapter.model.robot_names import FOLDER, ROBOT_FILES
from adapter.model.robot_names import robot_names as names
from adapter.model.self_model import SelfModel
from adapter.model.spatial import vector3
from adapter.model.urdf import read_urdf
from drivers.errors import choices


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
        name: one of `names()`, or the path of a file.
        joints: which joints are wanted, all where None; the others are locked.
        floating: whether the base is free.
        gravity: (3,) acceleration of gravity in base axes, m/s²; the file's own where None.
        lock: values of joints to be locked, rad, and m of prismatic ones (see `urdf.read_urdf`).

    Raises:
        ModelError: unknown name (names the choices), or a file that can't be read.
    """
    text = str(name)
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
