"""One check for all that comes in: a number that is not finite never reaches a parameter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from adapter.errors import ModelError
from adapter.spatial import Array
from adapter.tree_data import BodyMotion, TreeData


def check_finite(tables: Mapping[str, Array | None]) -> None:
    """Arrays by name, with samples, joints or bodies along the first axis; None is passed over.

    Raises:
        ModelError: a number that is not finite; says of which table and in which row.
    """
    for name, table in tables.items():
        if table is None or np.isfinite(table).all():
            continue
        row = int(np.argwhere(~np.isfinite(table))[0][0])
        raise ModelError(
            f"{name} holds numbers that are not finite, row {row} the first; leave such samples out"
        )


def check_motion(data: TreeData) -> None:
    """What λ is learned from: joint signals, motion of base and links."""
    links = {} if data.links is None else _parts("links", data.links)
    check_finite(_joints(data) | _parts("base", data.base) | links)


def check_dynamics(data: TreeData) -> None:
    """What torques are predicted from: joint signals and the base's accelerometer and gyro."""
    base = _parts("base", data.base)
    check_finite(_joints(data) | {name: base[name] for name in ("base.w", "base.a", "base.dw")})


def _joints(data: TreeData) -> dict[str, Array | None]:
    return {"q": data.q, "dq": data.dq, "ddq": data.ddq}


def _parts(name: str, motion: BodyMotion) -> dict[str, Array | None]:
    return {f"{name}.{part.name}": getattr(motion, part.name) for part in fields(motion)}
