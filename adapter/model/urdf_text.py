"""A self model as URDF text, with the joint axes that its source had.

What effects add to the arm comes in a record that knows nothing of them; `effects.robots` fills it.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from adapter.errors import ModelError
from adapter.model.inertia import (
    CONSISTENCY_TOLERANCE,
    body_from_theta,
    is_consistent,
    min_eigenvalue,
    six_from_tensor,
)
from adapter.model.self_model import LIMITS, SelfModel, base_inertia, gravity_down, turned_theta
from adapter.model.spatial import Array, at_joints, rpy_from_matrix, z_to_axis
from adapter.model.tree import BASE

# What a joint of a file may have beside its limits; a format has some of them.
DAMPING, FRICTION, ARMATURE, STIFFNESS = "damping", "friction", "armature", "stiffness"
URDF_PLACES = (DAMPING, FRICTION)
NO_PLACE = ""
SIX = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # of a tensor, as URDF names them
NO_INERTIA = """<inertial>
  <mass value="0"/>
  <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>
</inertial>"""


@dataclass(eq=False)
class Additions:
    """What a file of an arm holds beside the rigid arm itself.

    Attributes:
        n: joints; floating: whether the base is free.
        places: what a joint may have in this format.
        joint: (n,) by place: N m s/rad, N m, kg m², N m/rad (N s/m, N, kg, N/m of what slides).
        pull: (n,) N m, a spring's torque at q = 0.
        offset: (n,) of the encoders, rad or m.
        dtheta: (n, 10) what links weigh more than the model's θ, in their frames.
        loads: (10,) each, bodies that the last link carries, in its frame.
        tilt: (3, 3) how the base stands, None where upright.
        told: places and joints that an effect spoke of, be it by zero.
        left_out: what has no place, in words; names: of the effects in it, sorted.
    """

    n: int
    floating: bool
    places: tuple[str, ...]
    left_out: list[str] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    loads: list[Array] = field(default_factory=list)
    told: set[tuple[str, int]] = field(default_factory=set)
    tilt: Array | None = None

    def __post_init__(self) -> None:
        self.joint: dict[str, Array] = {place: np.zeros(self.n) for place in self.places}
        self.pull, self.offset = np.zeros((2, self.n))
        self.dtheta = np.zeros((self.n, 10))

    def at_joint(self, place: str, joint: int, value: float, part: str | None = None) -> str | None:
        """Add to what a joint has in a place.

        Returns:
            `part`, which says what of the effect that is, None for all of it; `NO_PLACE` where
            the format has no such place.
        """
        if place not in self.joint:
            return NO_PLACE
        self.joint[place][joint] += value
        self.told.add((place, joint))
        return part

    def carry(self, theta: Array) -> bool:
        """A body (10,) on the last link; within that link (False) where it could not be one."""
        alone = is_consistent(theta, -CONSISTENCY_TOLERANCE * float(np.max(np.abs(theta))))
        if alone:
            self.loads.append(theta)
        else:
            self.dtheta[-1] += theta
        return bool(alone)


def urdf_text(model: SelfModel, more: Additions) -> str:
    """URDF text of a model; the inverse of `urdf.read_urdf` up to rounding.

    Each link frame is turned back to its original axis, frames that ride on links come out as
    links of no mass on fixed joints (said in numbers: to a link without <inertial> PyBullet gives
    1 kg), a tool and loads as links of their own. A comment lists what has no place.

    Args:
        model: the arm; more: what it has beside, `places` being `URDF_PLACES`.

    Raises:
        ModelError: where a body is physically impossible; names the link and the eigenvalue.
    """
    tree, robot = model.tree, ET.Element("robot", name=model.name)
    missing = unplaced(model, more)
    if missing:
        robot.append(ET.Comment(comment_text(missing)))
    turns = {tree.base_name: np.eye(3)}
    turns.update({name: z_to_axis(model.axis[k]) for k, name in enumerate(tree.link_names)})
    base = base_inertia(model)
    if tree.floating or np.any(base):
        _add_link(robot, tree.base_name, base)
    else:
        _add_massless(robot, tree.base_name)
    for k, name in enumerate(tree.link_names):
        theta = model.theta[k - tree.n] + more.dtheta[k]
        _add_link(robot, name, turned_theta(theta, turns[name]))
        _add_joint(robot, model, k, turns, more)
    for frame in model.frames:
        _add_massless(robot, frame.name)
        turn = turns[frame.parent]
        joint = _joint(robot, frame.joint, "fixed", frame.parent, frame.name)
        _add_origin(joint, turn @ frame.rotation, turn @ frame.position)
    tool, loads = carried(model, more)
    for link, name, theta in (*tool, *loads):
        _add_link(robot, name, turned_theta(theta, turns[link]))
        _add_origin(_joint(robot, f"{name}_joint", "fixed", link, name), np.eye(3))
    if more.tilt is not None:
        upright = f"{tree.base_name}_upright"
        _add_massless(robot, upright)
        _add_origin(_joint(robot, f"{upright}_joint", "fixed", upright, tree.base_name), more.tilt)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


Carried = list[tuple[str, str, Array]]  # link, name of a body on it, and θ (10,) in its frame


def carried(model: SelfModel, more: Additions) -> tuple[Carried, Carried]:
    """The tool where there is one, and the loads; in files they are bodies of their own."""
    last, tool = model.tree.link_names[-1], Carried()
    if model.tool is not None:
        tool.append((model.tool_link, f"{model.tool_link}_tool", model.tool.theta()))
    names = (f"{last}_payload_{k + 1}" if k else f"{last}_payload" for k in range(len(more.loads)))
    return tool, [(last, name, load) for name, load in zip(names, more.loads, strict=True)]


def unplaced(model: SelfModel, more: Additions) -> list[str]:
    """What a URDF has no place for, in words; its gravity is upright."""
    if np.array_equal(model.gravity, gravity_down()):
        return more.left_out
    return [f"gravity {model.gravity.tolist()} m/s2 in base axes", *more.left_out]


def comment_text(left_out: list[str]) -> str:
    """Text of the comment; XML forbids two hyphens in a row in one."""
    text = " This file has no place for: " + "; ".join(left_out) + " "
    return text.replace("--", "- -")


def number_text(values: ArrayLike) -> str:
    """Numbers that read back unchanged; a negative zero loses its sign."""
    numbers = np.atleast_1d(np.asarray(values, dtype=np.float64))
    return " ".join(repr(float(value) + 0.0) for value in numbers)


def _add_origin(element: ET.Element, rotation: Array, position: Array | None = None) -> None:
    xyz = number_text(np.zeros(3) if position is None else position)
    ET.SubElement(element, "origin", xyz=xyz, rpy=number_text(rpy_from_matrix(rotation)))


def _add_link(robot: ET.Element, name: str, theta: Array) -> None:
    """A link with its inertia (10,) in its URDF frame."""
    link = ET.SubElement(robot, "link", name=name)
    check_possible(theta, name)
    mass, com, tensor = body_from_theta(theta)
    inertial = ET.SubElement(link, "inertial")
    _add_origin(inertial, np.eye(3), com)
    ET.SubElement(inertial, "mass", value=number_text(mass))
    six = {key: number_text(value) for key, value in six_named(tensor).items()}
    ET.SubElement(inertial, "inertia", six)


def _add_massless(robot: ET.Element, name: str) -> None:
    """A link that rides on another and weighs nothing."""
    robot.append(ET.fromstring(f"<link name={quoteattr(name)}>{NO_INERTIA}</link>"))


def check_possible(theta: Array, name: str) -> None:
    """Refuse (ModelError) a body that cannot exist."""
    smallest = float(min_eigenvalue(theta))
    if not smallest > CONSISTENCY_TOLERANCE * float(np.max(np.abs(theta))):
        raise ModelError(
            f"link '{name}' is physically impossible: its pseudo-inertia has an eigenvalue of "
            f"{smallest:.3g}, all must be positive; learn or set its inertia before exporting"
        )


def six_named(tensor: Array) -> dict[str, float]:
    """The elements of a tensor (3, 3) by the names that URDF's <inertia> has for them."""
    return dict(zip(SIX, six_from_tensor(tensor).tolist(), strict=True))


def at_zero(model: SelfModel, more: Additions, k: int) -> tuple[Array, Array]:
    """Frame of joint k (3, 3), (3,) where its sensor says zero: q = q_measured - offset."""
    frame = model.joint_rotation()[k], model.lam[k, 3:]
    return at_joints(*frame, -more.offset[k], model.tree.slides[k])


def _joint(robot: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _add_joint(
    robot: ET.Element, model: SelfModel, k: int, turns: dict[str, Array], more: Additions
) -> None:
    """Joint k, its frame turned back at both ends: R_urdf = Q_i R_ij Q_jᵀ, p_urdf = Q_i p."""
    tree, limits = model.tree, model.limits
    i = tree.parent[k]
    parent = tree.base_name if i == BASE else tree.link_names[i]
    child = tree.link_names[k]
    bounded = bool(np.isfinite(limits.lower[k]) and np.isfinite(limits.upper[k]))
    kind = "revolute" if bounded else "continuous"
    if tree.slides[k]:
        kind = "prismatic"
    joint = _joint(robot, tree.joint_names[k], kind, parent, child)
    rotation, position = at_zero(model, more, k)
    rotation = turns[parent] @ rotation @ turns[child].T
    _add_origin(joint, rotation, turns[parent] @ position)
    ET.SubElement(joint, "axis", xyz=number_text(model.axis[k]))
    own = ((place, more.joint[place][k]) for place in more.places)
    losses = {place: number_text(value) for place, value in own if value}
    if losses:
        ET.SubElement(joint, "dynamics", losses)
    values = {key: getattr(limits, key)[k] for key in LIMITS}
    known = {key: number_text(value) for key, value in values.items() if math.isfinite(value)}
    if tree.slides[k]:  # of these the format demands both; 0 says nothing
        known = dict.fromkeys(LIMITS[2:], "0") | known
    if known:
        ET.SubElement(joint, "limit", known)
