"""An estimate of λ, θ and effects as one message, and the arrays of it back again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.files.messages import Fields, header, stamp_of
from drivers.files.ros_types import LAMBDA_FIELDS, OFFSET_FIELDS, THETA_FIELDS
from drivers.interface import Array

FLAGS = ("learned", "lambda_source", "lambda_converged", "theta_converged")
JOINT_TABLES = ("lambda", "lambda_std", "offset")
BODY_TABLES = ("theta", "theta_std")
EFFECT_TABLES = ("effects", "effects_std", "effect_shapes")


@dataclass(frozen=True)
class EstimateNames:
    """Names of the rows: n joints, b bodies, e effects."""

    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    effects: tuple[str, ...]


def estimate_fields(stamp_ns: int, names: EstimateNames, values: Mapping[str, Any]) -> Fields:
    """Fields of a panda_adapter_msgs/Estimate.

    Args:
        stamp_ns: of the newest state learned from, on the arm's clock.
        values: `FLAGS`; lambda, lambda_std (n, 6); offset (n, 6) [turn; shift] of its frames
            off the documented ones, rad and m; theta, theta_std (b, 10); effects, effects_std,
            effect_shapes (e, n); torque_std (n,). A table that is missing is not known:
            not-a-number.
    """
    n, b, e = len(names.joints), len(names.bodies), len(names.effects)
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(JOINT_TABLES, (n, 6)),
        **dict.fromkeys(BODY_TABLES, (b, 10)),
        **dict.fromkeys(EFFECT_TABLES, (e, n)),
        "torque_std": (n,),
    }
    tables = {key: _table(values.get(key), shape) for key, shape in shapes.items()}
    joints = zip(names.joints, *(tables[key] for key in (*JOINT_TABLES, "torque_std")), strict=True)
    bodies = zip(names.bodies, *(tables[key] for key in BODY_TABLES), strict=True)
    parts = dict(zip(("value", "std", "shape"), EFFECT_TABLES, strict=True))
    return {
        "header": header(stamp_ns),
        **{key: values[key] for key in FLAGS},
        "joints": [
            {
                "name": name,
                "value": _row(LAMBDA_FIELDS, value),
                "std": _row(LAMBDA_FIELDS, std),
                "off": _row(OFFSET_FIELDS, off),
                "torque_std": torque_std,
            }
            for name, value, std, off, torque_std in joints
        ],
        "bodies": [
            {"name": name, "value": _row(THETA_FIELDS, value), "std": _row(THETA_FIELDS, std)}
            for name, value, std in bodies
        ],
        "effects": [
            {"effect": effect, "joint": joint, **{x: tables[y][k, j] for x, y in parts.items()}}
            for k, effect in enumerate(names.effects)
            for j, joint in enumerate(names.joints)
        ],
    }


def estimate_values(fields: Fields) -> dict[str, Any]:
    """The arrays and flags of a message, as `estimate_fields` takes them, with stamp and names."""
    joints, bodies, effects = fields["joints"], fields["bodies"], fields["effects"]
    n = len(joints)
    found: dict[str, Any] = {"stamp_ns": stamp_of(fields), **{key: fields[key] for key in FLAGS}}
    for table, rows, part, names in (
        ("lambda", joints, "value", LAMBDA_FIELDS),
        ("lambda_std", joints, "std", LAMBDA_FIELDS),
        ("offset", joints, "off", OFFSET_FIELDS),  # recordings before it have none
        ("theta", bodies, "value", THETA_FIELDS),
        ("theta_std", bodies, "std", THETA_FIELDS),
    ):
        values = [[row.get(part, {}).get(name, np.nan) for name in names] for row in rows]
        found[table] = np.array(values, dtype=np.float64).reshape(-1, len(names))
    for table, part in zip(EFFECT_TABLES, ("value", "std", "shape"), strict=True):
        found[table] = np.array([x[part] for x in effects], dtype=np.float64).reshape(-1, n or 1)
    found["torque_std"] = np.array([row["torque_std"] for row in joints], dtype=np.float64)
    found["joint_names"] = tuple(row["name"] for row in joints)
    found["body_names"] = tuple(row["name"] for row in bodies)
    found["effect_names"] = tuple(dict.fromkeys(x["effect"] for x in effects))
    return found


def _table(value: Any, shape: tuple[int, ...]) -> Array:
    if value is None:
        return np.full(shape, np.nan)
    table = np.asarray(value, dtype=np.float64)
    if not table.size and 0 in shape:
        return np.zeros(shape)
    if table.shape != shape:
        raise ValueError(f"a table of an estimate has shape {table.shape}, expected {shape}")
    return table


def _row(names: Sequence[str], values: Array) -> dict[str, float]:
    """A row of a table by the fields' names."""
    return dict(zip(names, values.tolist(), strict=True))
