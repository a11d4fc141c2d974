"""A model with its effects as a simulator's files: each effect writes itself.

A file's reader gets friction, the load and the inertias, the zero of the encoders and the tilt of
the base under its own, upright gravity, so that the rigid arm in it takes the torque of the
model's; what has no place in a format is said in words.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.effects.active import Active, active_effects
from adapter.model.self_model import SelfModel
from adapter.model.urdf_text import (
    ARMATURE,
    DAMPING,
    FRICTION,
    STIFFNESS,
    URDF_PLACES,
    Additions,
    urdf_text,
)

# MuJoCo's names of what a joint has: <joint damping=... frictionloss=... armature=...>.
MJCF_ATTRIBUTES = {
    DAMPING: "damping",
    FRICTION: "frictionloss",
    ARMATURE: "armature",
    STIFFNESS: "stiffness",
}


def to_urdf(model: SelfModel) -> str:
    """URDF text of a model with its effects, as far as a URDF goes (see `model.urdf_text`).

    Raises:
        ModelError: where a body is physically impossible; names the link and the eigenvalue.
    """
    return urdf_text(model, additions(model, URDF_PLACES))


def left_out_of_urdf(model: SelfModel) -> list[str]:
    """Names of the effects that a URDF has no place for, or not for all of them."""
    return additions(model, URDF_PLACES).names


def mjcf_joints(model: SelfModel) -> tuple[dict[str, float], ...]:
    """Attributes of each <joint> in MJCF, SI units: angle="radian" in the file's <compiler>."""
    more = additions(model, tuple(MJCF_ATTRIBUTES))
    joints = []
    for j in range(model.tree.n):
        own = {MJCF_ATTRIBUTES[place]: float(x[j]) for place, x in more.joint.items() if x[j]}
        if more.joint[STIFFNESS][j]:  # -stiffness (q - springref) is what MuJoCo adds
            own["springref"] = float(more.pull[j] / -more.joint[STIFFNESS][j])
        joints.append(own)
    return tuple(joints)


def additions(model: SelfModel, places: Sequence[str]) -> Additions:
    """What the model's effects add to a file whose joints have these places."""
    more, names = Additions(model.tree.n, model.tree.floating, tuple(places)), set()
    for active in active_effects(model.effects, model.tree.n):
        note = "it ended"
        if active.lasting:
            part = active.effect.export(more, active.joint, active.values)
            if part is None:
                continue
            note = part
        more.left_out.append(_said(model, active) + (f" ({note})" if note else ""))
        names.add(active.effect.name)
    more.without_negative(model.tree.joint_names)
    more.names = sorted(names)
    return more


def _said(model: SelfModel, active: Active) -> str:
    """An effect in words: name, joint, parameters with units."""
    units = active.effect.units()
    where = "" if active.joint < 0 else f" of {model.tree.joint_names[active.joint]}"
    numbers = (f"{key} = {_number(x)} {units[key]}" for key, x in active.values.items())
    return f"{active.effect.name}{where}, {', '.join(numbers)}"


def _number(value: object) -> str:
    return repr(value) if isinstance(value, int | float) else str(np.asarray(value).tolist())
