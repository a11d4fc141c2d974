"""A load at the hand as people, programs and robots' own tools take it.

Formats. libfranka: `setLoad(mass, F_x_Cload, load_inertia)`, flange frame, inertia about the centre
of mass, column by column. Franka Desk: the end effector's JSON file, the same numbers with the
place of the tool, 4x4, column by column. Universal Robots: `set_payload(m, cog)`, and since
PolyScope 5.10 `set_target_payload(m, cog, [Ixx, Iyy, Izz, Ixy, Ixz, Iyz])`, in axes of the flange.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from adapter.gap.load import HandLoad
from adapter.model.inertia import six_from_tensor
from adapter.model.numbers import plus_minus
from adapter.model.spatial import Array

_SIX = ("XX", "XY", "XZ", "YY", "YZ", "ZZ")
NOT_SHOWN = "not shown"


def sentence(load: HandLoad) -> str:
    """What the hand carries, with standard deviations."""
    mass = f"{plus_minus(load.mass, load.mass_std)} kg"
    if not load.is_there:
        less = load.mass < -3.0 * load.mass_std
        why = "the hand is lighter than the model says, or its inertias are wrong"
        return f"no load is shown: {mass}" + (f"; {why}" if less else "")
    where = NOT_SHOWN + " by this log; turn the hand about several axes"
    if load.com_shown:
        pairs = zip("xyz", 1e3 * load.com, 1e3 * load.com_std, strict=True)
        where = ", ".join(f"{axis} {at:.1f} ± {std:.1f}" for axis, at, std in pairs) + " mm"
    turning = NOT_SHOWN + " by this log; turn the hand faster, about several axes"
    if load.inertia_shown:
        numbers = zip(
            _SIX, *(six_from_tensor(x) for x in (load.inertia, load.inertia_std)), strict=True
        )
        turning = ", ".join(f"{key} {x:.2g} ± {std:.1g}" for key, x, std in numbers) + " kg m²"
    return (
        f"the hand carries {mass}; centre of mass, in {load.frame}: {where}; inertia about it: "
        f"{turning}"
    )


def robot_lines(load: HandLoad) -> dict[str, str]:
    """What to give to each robot, by its name; nothing where the centre is not shown."""
    if not load.com_shown:
        return {}
    com, six = _rounded(load.com), _rounded(_inertia(load)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    mass, columns = round(load.mass, 4), _columns(load)
    braces = ", ".join("{{" + ", ".join(map(str, x)) + "}}" for x in (com, columns))
    return {
        "libfranka": f"robot.setLoad({mass}, {braces});",
        "Franka Desk": json.dumps(desk(load)),
        "UR": f"set_payload({mass}, {com})",
        "UR, PolyScope 5.10 on": f"set_target_payload({mass}, {com}, {six})",
    }


def desk(load: HandLoad) -> dict[str, Any]:
    """An end effector as Franka Desk reads it; its own place is left as it is."""
    return {
        "mass": round(load.mass, 4),
        "centerOfMass": _rounded(load.com),
        "transformation": np.eye(4).ravel().tolist(),
        "inertia": _columns(load),
    }


def as_json(load: HandLoad) -> dict[str, Any]:
    """Everything, ready for JSON; None for what is not shown."""
    com, inertia = load.com_shown, load.inertia_shown
    return {
        "frame": load.frame,
        "is_there": load.is_there,
        "mass_kg": load.mass,
        "mass_std_kg": load.mass_std,
        "com_m": load.com.tolist() if com else None,
        "com_std_m": load.com_std.tolist() if com else None,
        "inertia_kg_m2": load.inertia.tolist() if inertia else None,
        "inertia_std_kg_m2": load.inertia_std.tolist() if inertia else None,
        "set_load": {
            "mass": load.mass,
            "F_x_Cload": load.com.tolist(),
            "load_inertia": _inertia(load).ravel(order="F").tolist(),
        }
        if com
        else None,
        "desk": desk(load) if com else None,
        "robots": robot_lines(load),
        "torque_rmse_nm": {"before": load.before_nm.tolist(), "after": load.left_nm.tolist()},
        "sentence": sentence(load),
        "notes": list(load.notes),
    }


def _inertia(load: HandLoad) -> Array:
    """(3, 3) kg m², zeros where it is not shown: robots take a point's."""
    return load.inertia if load.inertia_shown else np.zeros((3, 3))


def _columns(load: HandLoad) -> list[float]:
    return _rounded(_inertia(load).ravel(order="F"), 6)


def _rounded(values: Array, digits: int = 5) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]
