"""A self model as URDF, with the joint axes that its source had."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np

from adapter.errors import ModelError
from adapter.export_effects import UrdfParts, comment
from adapter.inertia import CONSISTENCY_TOLERANCE, body_from_theta, min_eigenvalue, six_from_tensor
from adapter.model import SelfModel, base_inertia, link_theta, turned_theta
from adapter.spatial import Array, rot_z, rpy_from_matrix, z_to_axis
from adapter.tree import BASE


def to_urdf(model: SelfModel) -> str:
    """URDF text of a model; the inverse of `urdf.read_urdf` up to rounding.

    Each link frame is turned back to its original axis, frames that ride on links come out as
    massless links on fixed joints, a tool as a link of its own. A fixed base may be massless.
    Effects come along as far as a URDF goes (`export_effects`), so that the rigid arm in it, its
    base upright, takes the torque of the model's; a comment lists what does not.

    Raises:
        ModelError: where a body is physically impossible; names the link and the eigenvalue.
    """
    tree, parts = model.tree, UrdfParts.of(model)
    robot = ET.Element("robot", name=model.name)
    if parts.left_out:
        robot.append(ET.Comment(comment(parts.left_out)))
    turns = {tree.base_name: np.eye(3)}
    turns.update({name: z_to_axis(model.axis[k]) for k, name in enumerate(tree.link_names)})
    base = base_inertia(model)
    massless_base = not tree.floating and not np.any(base)
    _add_link(robot, tree.base_name, None if massless_base else base)
    for k, name in enumerate(tree.link_names):
        _add_link(robot, name, turned_theta(link_theta(model)[k] + parts.dtheta[k], turns[name]))
        _add_joint(robot, model, k, turns, parts)
    for frame in model.frames:
        _add_link(robot, frame.name, None)
        turn = turns[frame.parent]
        joint = _joint(robot, frame.joint, "fixed", frame.parent, frame.name)
        _add_origin(joint, turn @ frame.rotation, turn @ frame.position)
    if model.tool is not None:
        link = model.tool_link
        _add_load(robot, link, "tool", turned_theta(model.tool.theta(), turns[link]))
    last = tree.link_names[-1]
    for k, load in enumerate(parts.loads):
        what = "payload" if k == 0 else f"payload_{k + 1}"
        _add_load(robot, last, what, turned_theta(load, turns[last]))
    if parts.tilt is not None:
        upright = f"{tree.base_name}_upright"
        _add_link(robot, upright, None)
        _add_origin(_joint(robot, f"{upright}_joint", "fixed", upright, tree.base_name), parts.tilt)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _text(values: Array) -> str:
    """Numbers that read back unchanged; a negative zero loses its sign."""
    return " ".join(repr(float(value) + 0.0) for value in np.atleast_1d(values))


def _add_origin(element: ET.Element, rotation: Array, position: Array | None = None) -> None:
    xyz = _text(np.zeros(3) if position is None else position)
    ET.SubElement(element, "origin", xyz=xyz, rpy=_text(rpy_from_matrix(rotation)))


def _add_link(robot: ET.Element, name: str, theta: Array | None) -> None:
    """A link with its inertia (10,) in its URDF frame; without any where None."""
    link = ET.SubElement(robot, "link", name=name)
    if theta is None:
        return
    smallest = float(min_eigenvalue(theta))
    if not smallest > CONSISTENCY_TOLERANCE * float(np.max(np.abs(theta))):
        raise ModelError(
            f"link '{name}' is physically impossible: its pseudo-inertia has an eigenvalue of "
            f"{smallest:.3g}, all must be positive; learn or set its inertia before exporting"
        )
    mass, com, tensor = body_from_theta(theta)
    inertial = ET.SubElement(link, "inertial")
    _add_origin(inertial, np.eye(3), com)
    ET.SubElement(inertial, "mass", value=_text(mass))
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    six = {key: _text(value) for key, value in zip(keys, six_from_tensor(tensor), strict=True)}
    ET.SubElement(inertial, "inertia", six)


def _add_load(robot: ET.Element, link: str, what: str, theta: Array) -> None:
    """A body that a link carries, as a link of its own on a fixed joint."""
    name = f"{link}_{what}"
    _add_link(robot, name, theta)
    _add_origin(_joint(robot, f"{name}_joint", "fixed", link, name), np.eye(3))


def _joint(robot: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _add_joint(
    robot: ET.Element, model: SelfModel, k: int, turns: dict[str, Array], parts: UrdfParts
) -> None:
    """Joint k, its frame turned back at both ends: R_urdf = Q_i R_ij Q_jᵀ, p_urdf = Q_i p."""
    tree, limits = model.tree, model.limits
    i = tree.parent[k]
    parent = tree.base_name if i == BASE else tree.link_names[i]
    child = tree.link_names[k]
    bounded = bool(np.isfinite(limits.lower[k]) and np.isfinite(limits.upper[k]))
    kind = "revolute" if bounded else "continuous"
    joint = _joint(robot, tree.joint_names[k], kind, parent, child)
    zero = model.joint_rotation()[k] @ rot_z(-parts.offset[k])  # q = q_measured - offset
    rotation = turns[parent] @ zero @ turns[child].T
    _add_origin(joint, rotation, turns[parent] @ model.lam[k, 3:])
    ET.SubElement(joint, "axis", xyz=_text(model.axis[k]))
    losses = {"damping": parts.damping[k], "friction": parts.friction[k]}
    if any(losses.values()):
        known = {key: _text(value) for key, value in losses.items() if value}
        ET.SubElement(joint, "dynamics", known)
    values = {
        "lower": limits.lower[k],
        "upper": limits.upper[k],
        "velocity": limits.velocity[k],
        "effort": limits.effort[k],
    }
    known = {key: _text(value) for key, value in values.items() if math.isfinite(value)}
    if known:
        ET.SubElement(joint, "limit", known)
