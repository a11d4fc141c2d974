"""A self model as URDF, MJCF, SDF, USD and Isaac Lab's actuators: numbers filled into templates."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from adapter.model import urdf_text as texts
from adapter.model.inertia import body_from_theta
from adapter.model.robot_file import SLIDING, FileJoint, FileRobot
from adapter.model.self_model import LIMITS, SelfModel
from adapter.model.spatial import Array, quaternion_from_matrix, rpy_from_matrix, z_to_axis
from adapter.model.urdf_text import Additions, as_file, number_text, six_named

# MuJoCo's names of what a joint has: <joint damping=... frictionloss=... armature=...>.
MJCF_PLACES = {texts.DAMPING: "damping", texts.FRICTION: "frictionloss", texts.ARMATURE: "armature"}
MJCF_PLACES[texts.STIFFNESS] = "stiffness"
# MuJoCo 4 has damping as a polynomial, (b0 + b1 |dq| + b2 dq²) dq, of which these are the last two.
MJCF_PLACES |= {texts.DRAG: texts.DRAG, texts.CUBIC_DRAG: texts.CUBIC_DRAG}
PLACES = {  # of what joints have beside, by format, which is what its template is called
    "urdf": (texts.DAMPING, texts.FRICTION),
    "mjcf": tuple(MJCF_PLACES),
    "sdf": (texts.DAMPING, texts.FRICTION, texts.STIFFNESS),
    "usd": (texts.DAMPING, texts.FRICTION, texts.BREAKAWAY, texts.ARMATURE),
}
PLACES["isaac"] = PLACES["usd"]


@lru_cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=lambda name: str(name).endswith(".xml"),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    own: dict[str, Any] = {"n": number_text, "six": six_named}
    own |= {"quat": quaternion_from_matrix, "rpy": rpy_from_matrix, "degree": math.pi / 180.0}
    own["mjcf"] = lambda more, joint: as_written(joint_attributes(more, joint))
    own["quoted"] = lambda name: repr(re.escape(name))
    own["id"] = lambda name: re.sub(r"^(?=\d)|\W", "_", name, flags=re.ASCII)  # as USD takes one
    environment.globals |= own
    return environment


def filled(kind: str, model: SelfModel, more: Additions, robot: FileRobot | None = None) -> str:
    """An arm's numbers in the text of a format.

    Args:
        kind: of `PLACES`; model: the arm; more: what it has beside, `places` being the format's.
        robot: links and joints to write where they are not as `as_file` has them.

    Raises:
        ModelError: as `urdf_text.as_file`.
    """
    robot = robot or as_file(model, more)
    over = {joint.child: joint for joint in robot.joints.values()}
    riding, stands = {x.name for x in model.frames}, np.eye(3) if more.tilt is None else more.tilt
    places = {model.tree.base_name: (stands, np.zeros(3))}
    for name, joint in over.items():  # parents first, in `as_file`
        r, p = places.setdefault(joint.parent, (stands, np.zeros(3)))
        places[name] = r @ joint.rotation, p + r @ joint.position
    masses, coms, tensors = body_from_theta(np.stack(list(robot.links.values())))
    bodies = zip(robot.links, masses, coms, tensors, *principal(tensors), strict=True)
    keys = ("name", "mass", "com", "tensor", "moments", "axes")
    links = {body[0]: SimpleNamespace(**dict(zip(keys, body, strict=True))) for body in bodies}
    for name, link in links.items():
        link.place, link.rides = places[name], over[name] if name in riding else None
    joints = [_joint(x, links, model, more) for x in robot.joints.values()]
    turns = np.stack([(x.rotation, x.rotation @ x.turn, x.turn) for x in joints])
    for joint, quats in zip(joints, quaternion_from_matrix(turns), strict=True):
        joint.quat, joint.quat0, joint.quat1 = quats  # of its child in its parent, of z in both
    facts = {"model": model, "more": more, "stands": stands, "links": links, "joints": joints}
    template = _environment().select_template([f"{kind}.xml", f"{kind}.txt"])
    text: str = template.render(**facts) + "\n"
    if str(template.name).endswith(".txt"):
        return text
    ET.indent(root := ET.fromstring(text))
    head = '<?xml version="1.0"?>\n' * text.startswith("<?")
    return head + ET.tostring(root, encoding="unicode") + "\n"


def _joint(joint: FileJoint, links: dict[str, Any], model: SelfModel, more: Additions) -> Any:
    """A joint's numbers by name; `turn` (3, 3) takes z to its axis."""
    names, turn, k = model.tree.joint_names, np.eye(3), None
    own: dict[str, Any] = dict.fromkeys(("damping", "friction", "breakaway", "rest"), 0.0)
    told = set[str]()
    if joint.name in names:
        k, turn = names.index(joint.name), z_to_axis(joint.axis)
        own |= {key: float(x[k]) for key, x in more.joint.items()}
        told = {key for key, number in more.told if number == k}
        own["rest"] = joint_attributes(more, k).get("springref", 0.0)
    limits = dict(zip(LIMITS, joint.limits.tolist(), strict=True))
    own |= vars(joint) | {"parent": links[joint.parent], "child": links[joint.child]}
    own |= {"limits": {key: x for key, x in limits.items() if math.isfinite(x)}, "number": k}
    own |= {"moves": k is not None, "slides": joint.kind in SLIDING, "told": told, "turn": turn}
    return SimpleNamespace(**own, static=own["friction"] + own["breakaway"])


def joint_attributes(more: Additions, joint: int) -> dict[str, float]:
    """What a joint has beside the rigid arm, by MuJoCo's names, of what effects spoke of."""
    told = {place: name for place, name in MJCF_PLACES.items() if (place, joint) in more.told}
    own = {name: float(more.joint[place][joint]) for place, name in told.items()}
    if own.get("stiffness"):  # -stiffness (q - springref) is what MuJoCo adds
        own["springref"] = float(more.pull[joint] / -own["stiffness"])
    return own


def as_written(own: dict[str, float]) -> dict[str, float | list[float]]:
    """What a joint has beside, as an MJCF has it: damping with its polynomial in one."""
    places = texts.DRAG, texts.CUBIC_DRAG
    out: dict[str, float | list[float]] = {k: x for k, x in own.items() if k not in places}
    if len(out) < len(own):  # before MuJoCo 4 there is no polynomial, nor a need where it is zero
        damping, drags = own.get("damping", 0.0), [own.get(place, 0.0) for place in places]
        out["damping"] = [damping, *drags] if any(drags) else damping
    return out


def principal(tensor: Array) -> tuple[Array, Array]:
    """Principal moments (..., 3) of inertia tensors and their axes, [w x y z] (..., 4)."""
    moments, axes = np.linalg.eigh(tensor)
    axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]  # right-handed
    return moments, quaternion_from_matrix(axes)
