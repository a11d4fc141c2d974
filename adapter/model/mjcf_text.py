"""A self model as MJCF text (MuJoCo's XML), with the joint axes that its source had."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike

from adapter.model import urdf_text as texts
from adapter.model.inertia import body_from_theta
from adapter.model.robot_file import SLIDING
from adapter.model.self_model import SelfModel, base_inertia
from adapter.model.spatial import Array, quaternion_from_matrix

# MuJoCo's names of what a joint has: <joint damping=... frictionloss=... armature=...>.
MJCF_PLACES = {texts.DAMPING: "damping", texts.FRICTION: "frictionloss", texts.ARMATURE: "armature"}
MJCF_PLACES[texts.STIFFNESS] = "stiffness"
WORLD = "world"  # MuJoCo's name for what does not move; no body may have it


def mjcf_text(model: SelfModel, more: texts.Additions) -> str:
    """MJCF text of the arm alone, its bodies where the links of its URDF are.

    Gravity is the model's. Limits of speed have no place.

    Args:
        model: the arm; more: what it has beside, `places` being those of `MJCF_PLACES`.

    Raises:
        ModelError: as `urdf_text.as_file`.
    """
    file, robot = texts.as_file(model, more), ET.Element("mujoco", model=model.name)
    ET.SubElement(robot, "compiler", angle="radian", autolimits="true")
    ET.SubElement(robot, "option", gravity=texts.number_text(model.gravity))
    on = _base(ET.SubElement(robot, "worldbody"), model, more)
    for joint in file.joints.values():
        on[joint.child] = _body(on[joint.parent], joint.child, joint.rotation, joint.position)
        if np.any(theta := file.links[joint.child]):
            ET.SubElement(on[joint.child], "inertial", inertial_attributes(theta))
        if joint.name not in model.tree.joint_names:
            continue
        kind = "slide" if joint.kind in SLIDING else "hinge"
        told: dict[str, ArrayLike] = {"axis": joint.axis}
        if np.isfinite(joint.limits[:2]).all():
            told["range"] = joint.limits[:2]
        if np.isfinite(joint.limits[3]):
            told["actuatorfrcrange"] = joint.limits[3] * np.array([-1.0, 1.0])
        own = joint_attributes(more, model.tree.joint_names.index(joint.name))
        told |= {key: value for key, value in own.items() if value}
        numbers = {key: texts.number_text(value) for key, value in told.items()}
        ET.SubElement(on[joint.child], "joint", {"name": joint.name, "type": kind, **numbers})
    ET.indent(robot)
    return ET.tostring(robot, encoding="unicode") + "\n"


def _base(world: ET.Element, model: SelfModel, more: texts.Additions) -> dict[str, ET.Element]:
    """The base in the world, by its name."""
    name, theta = model.tree.base_name, base_inertia(model)
    if name == WORLD and more.tilt is None and not model.tree.floating:
        return {name: world}
    name_there = f"{name}_base" if name == WORLD else name
    tilt = np.eye(3) if more.tilt is None else more.tilt
    body = _body(world, name_there, tilt, np.zeros(3))
    if np.any(theta):
        ET.SubElement(body, "inertial", inertial_attributes(theta))
    if model.tree.floating:
        ET.SubElement(body, "freejoint")
    return {name: body}


def _body(on: ET.Element, name: str, rotation: Array, position: ArrayLike) -> ET.Element:
    place = {
        "pos": texts.number_text(position),
        "quat": texts.number_text(quaternion_from_matrix(rotation)),
    }
    return ET.SubElement(on, "body", {"name": name, **place})


def inertial_attributes(theta: Array) -> dict[str, str]:
    """What <inertial> says of a body (10,): centre, principal axes, mass and inertias."""
    mass, com, tensor = body_from_theta(theta)
    principal, axes = np.linalg.eigh(tensor)
    axes[:, 0] *= np.sign(np.linalg.det(axes))  # right-handed
    values = {"pos": com, "quat": quaternion_from_matrix(axes)}
    values |= {"mass": mass, "diaginertia": principal}
    return {key: texts.number_text(value) for key, value in values.items()}


def joint_attributes(more: texts.Additions, joint: int) -> dict[str, float]:
    """What a joint has beside the rigid arm, by MuJoCo's names, of what effects spoke of."""
    told = {place: name for place, name in MJCF_PLACES.items() if (place, joint) in more.told}
    own = {name: float(more.joint[place][joint]) for place, name in told.items()}
    if own.get("stiffness"):  # -stiffness (q - springref) is what MuJoCo adds
        own["springref"] = float(more.pull[joint] / -own["stiffness"])
    return own
