"""A self model as URDF, MJCF, SDF, USD and Isaac Lab's actuators: numbers filled into templates.

Joint axes are those that its source had. Each format's places for what joints have beside stand
here; their names in it are in `templates/`.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from adapter.model.inertia import body_from_theta
from adapter.model.robot_file import SLIDING, FileJoint
from adapter.model.self_model import LIMITS, SelfModel
from adapter.model.spatial import Array, quaternion_from_matrix, rpy_from_matrix, z_to_axis
from adapter.model.urdf_text import (
    ARMATURE,
    BREAKAWAY,
    DAMPING,
    FRICTION,
    STIFFNESS,
    Additions,
    as_file,
    number_text,
    six_named,
)

# MuJoCo's names of what a joint has: <joint damping=... frictionloss=... armature=...>.
MJCF_PLACES = {DAMPING: "damping", FRICTION: "frictionloss", ARMATURE: "armature"}
MJCF_PLACES[STIFFNESS] = "stiffness"
PLACES = {  # of what joints have beside, by format, which is what its template is called
    "urdf": (DAMPING, FRICTION),
    "mjcf": tuple(MJCF_PLACES),
    "sdf": (DAMPING, FRICTION, STIFFNESS),
    "usd": (DAMPING, FRICTION, BREAKAWAY, ARMATURE),
    "isaac": (DAMPING, FRICTION, BREAKAWAY, ARMATURE),
}


@lru_cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=lambda name: str(name).endswith(".xml"),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    own: dict[str, Any] = {"n": number_text, "six": six_named, "mjcf": joint_attributes}
    own |= {"quat": quaternion_from_matrix, "rpy": rpy_from_matrix, "degree": math.pi / 180.0}
    own["id"] = lambda name: re.sub(r"^(?=\d)|\W", "_", name, flags=re.ASCII)  # as USD takes one
    environment.globals |= own
    return environment


def filled(kind: str, model: SelfModel, more: Additions) -> str:
    """An arm's numbers in the text of a format.

    Args:
        kind: of `PLACES`; model: the arm; more: what it has beside, `places` being the format's.

    Raises:
        ModelError: as `urdf_text.as_file`.
    """
    robot = as_file(model, more)
    over = {joint.child: joint for joint in robot.joints.values()}
    riding, stands = {x.name for x in model.frames}, np.eye(3) if more.tilt is None else more.tilt
    places = {model.tree.base_name: (stands, np.zeros(3))}
    for name, joint in over.items():  # parents first
        r, p = places[joint.parent]
        places[name] = r @ joint.rotation, p + r @ joint.position
    masses, coms, tensors = body_from_theta(np.stack(list(robot.links.values())))
    bodies = zip(robot.links, masses, coms, tensors, *_principal(tensors), strict=True)
    keys = ("name", "mass", "com", "tensor", "moments", "axes")
    links = {body[0]: SimpleNamespace(**dict(zip(keys, body, strict=True))) for body in bodies}
    for name, link in links.items():
        link.place, link.rides = places[name], over[name] if name in riding else None
    joints = [_joint(x, links, model, more) for x in robot.joints.values()]
    turns = np.stack([(x.rotation, x.rotation @ x.turn, x.turn) for x in joints])
    for joint, quats in zip(joints, quaternion_from_matrix(turns), strict=True):
        joint.quat, joint.quat0, joint.quat1 = quats  # of its child in its parent, of z in both
    moving = [x for x in joints if x.moves]

    def numbers(key: str) -> dict[str, Any]:
        found = {re.escape(x.name): getattr(x, key, x.limits.get(key)) for x in moving}
        place = FRICTION if key == "static" else key
        told = place not in more.joint or any(place in x.told for x in moving)
        return found if told and all(x is not None for x in found.values()) else {}

    facts = {"model": model, "more": more, "stands": stands, "links": links, "joints": joints}
    template = _environment().select_template([f"{kind}.xml", f"{kind}.txt"])
    text: str = template.render(**facts, numbers=numbers) + "\n"
    if str(template.name).endswith(".txt"):
        return text
    ET.indent(root := ET.fromstring(text))
    head = '<?xml version="1.0"?>\n' * text.startswith("<?")
    return head + ET.tostring(root, encoding="unicode") + "\n"


def _joint(joint: FileJoint, links: dict[str, Any], model: SelfModel, more: Additions) -> Any:
    """A joint's numbers by name; `turn` (3, 3) takes z to its axis."""
    names, turn, k = model.tree.joint_names, np.eye(3), None
    own, told = dict.fromkeys((*more.joint, BREAKAWAY, FRICTION, DAMPING), 0.0), set[str]()
    if joint.name in names:
        k, turn = names.index(joint.name), z_to_axis(joint.axis)
        own |= {key: float(x[k]) for key, x in more.joint.items()}
        told = {key for key, number in more.told if number == k}
        own["rest"] = float(more.pull[k] / -own[STIFFNESS]) if own.get(STIFFNESS) else 0.0
    limits = dict(zip(LIMITS, joint.limits.tolist(), strict=True))
    own |= vars(joint) | {"parent": links[joint.parent], "child": links[joint.child]}
    return SimpleNamespace(
        **own | {"limits": {key: x for key, x in limits.items() if math.isfinite(x)}},
        number=k,
        moves=k is not None,
        slides=joint.kind in SLIDING,
        static=own[FRICTION] + own[BREAKAWAY],
        told=told,
        turn=turn,
    )


def inertial_attributes(theta: Array) -> dict[str, str]:
    """What MuJoCo's <inertial> says of a body (10,): centre, principal axes, mass, inertias."""
    mass, com, tensor = body_from_theta(theta)
    moments, axes = _principal(tensor)
    values = {"pos": com, "quat": axes, "mass": mass, "diaginertia": moments}
    return {key: number_text(value) for key, value in values.items()}


def joint_attributes(more: Additions, joint: int) -> dict[str, float]:
    """What a joint has beside the rigid arm, by MuJoCo's names, of what effects spoke of."""
    told = {place: name for place, name in MJCF_PLACES.items() if (place, joint) in more.told}
    own = {name: float(more.joint[place][joint]) for place, name in told.items()}
    if own.get("stiffness"):  # -stiffness (q - springref) is what MuJoCo adds
        own["springref"] = float(more.pull[joint] / -own["stiffness"])
    return own


def _principal(tensor: Array) -> tuple[Array, Array]:
    """Principal moments (..., 3) of inertia tensors and their axes, [w x y z] (..., 4)."""
    moments, axes = np.linalg.eigh(tensor)
    axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]  # right-handed
    return moments, quaternion_from_matrix(axes)
