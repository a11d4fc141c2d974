"""A self model as MJCF text (MuJoCo's XML), with the joint axes that its source had."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import ArrayLike

from adapter.model import urdf_text as texts
from adapter.model.inertia import body_from_theta
from adapter.model.self_model import SelfModel, base_inertia, turned_theta
from adapter.model.spatial import Array, quaternion_from_matrix, z_to_axis
from adapter.model.tree import BASE

# MuJoCo's names of what a joint has: <joint damping=... frictionloss=... armature=...>.
MJCF_PLACES = {texts.DAMPING: "damping", texts.FRICTION: "frictionloss", texts.ARMATURE: "armature"}
MJCF_PLACES[texts.STIFFNESS] = "stiffness"
WORLD = "world"  # MuJoCo's name for what does not move; no body may have it


def mjcf_text(model: SelfModel, more: texts.Additions) -> str:
    """MJCF text of the arm alone.

    Bodies stand where the links of the arm's URDF do, a tool and loads as bodies of their own,
    frames that ride on links as bodies of no mass. Gravity is the model's. Limits of speed have
    no place. A comment lists what else has none.

    Args:
        model: the arm; more: what it has beside, `places` being those of `MJCF_PLACES`.

    Raises:
        ModelError: where a body is physically impossible; names it.
    """
    tree = model.tree
    robot = ET.Element("mujoco", model=model.name)
    if more.left_out:
        robot.append(ET.Comment(texts.comment_text(more.left_out)))
    ET.SubElement(robot, "compiler", angle="radian", autolimits="true")
    ET.SubElement(robot, "option", gravity=texts.number_text(model.gravity))
    on = _base(ET.SubElement(robot, "worldbody"), model, more)
    turns = {tree.base_name: np.eye(3)}
    for k, name in enumerate(tree.link_names):
        i = tree.parent[k]
        parent = tree.base_name if i == BASE else tree.link_names[i]
        turns[name] = z_to_axis(model.axis[k])
        rotation, position = texts.at_zero(model, more, k)
        placed = turns[parent] @ rotation @ turns[name].T, turns[parent] @ position
        on[name] = _body(on[parent], name, *placed)
        theta = turned_theta(model.theta[k - tree.n] + more.dtheta[k], turns[name])
        on[name].append(_inertial(theta, name))
        kind = "slide" if tree.slides[k] else "hinge"
        hinge = {
            "name": tree.joint_names[k],
            "type": kind,
            "axis": texts.number_text(model.axis[k]),
        }
        span = np.array([model.limits.lower[k], model.limits.upper[k]])
        if np.isfinite(span).all():
            hinge["range"] = texts.number_text(span)
        effort = model.limits.effort[k]
        if np.isfinite(effort):
            hinge["actuatorfrcrange"] = texts.number_text([-effort, effort])
        own = joint_attributes(more, k)
        hinge |= {key: texts.number_text(value) for key, value in own.items() if value}
        ET.SubElement(on[name], "joint", hinge)
    for frame in model.frames:
        turn = turns[frame.parent]
        _body(on[frame.parent], frame.name, turn @ frame.rotation, turn @ frame.position)
    tool, loads = texts.carried(model, more)
    for link, name, theta in (*loads, *tool):
        load = _body(on[link], name, np.eye(3), np.zeros(3))
        load.append(_inertial(turned_theta(theta, turns[link]), name))
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
        body.append(_inertial(theta, name))
    if model.tree.floating:
        ET.SubElement(body, "freejoint")
    return {name: body}


def _body(on: ET.Element, name: str, rotation: Array, position: ArrayLike) -> ET.Element:
    place = {
        "pos": texts.number_text(position),
        "quat": texts.number_text(quaternion_from_matrix(rotation)),
    }
    return ET.SubElement(on, "body", {"name": name, **place})


def _inertial(theta: Array, name: str) -> ET.Element:
    """<inertial> of a body (10,) in its own frame, about its principal axes."""
    texts.check_possible(theta, name)
    return ET.Element("inertial", inertial_attributes(theta))


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
