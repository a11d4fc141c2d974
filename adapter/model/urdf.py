"""URDF into a self model: frames turned to their axes, fixed links merged, the rest locked.

The rule of the axes: the frame of a link that turns about axis u of its URDF frame is that
frame, turned by the smallest rotation Q that takes z to u (`spatial.z_to_axis`; by π about x for
u = -z). Then Rot(u, q) = Q Rz(q) Qᵀ, and the joint turns about its own z as eq. 9 of the paper
wants it: R_ij = Q_iᵀ R_urdf Q_j Rz(q), p = Q_iᵀ p_urdf. `urdf_text` undoes it.
"""

from __future__ import annotations

import math
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from adapter.errors import ModelError, ModelWarning
from adapter.model.inertia import move_theta, tensor_from_six, theta_from_body
from adapter.model.self_model import FixedFrame, Limits, SelfModel, gravity_down, turned_theta
from adapter.model.spatial import Array, matrix_from_rpy, vector3, z_to_axis, zxz_from_matrix
from adapter.model.tree import BASE, Tree

TURNING = ("revolute", "continuous")
JOINT_TYPES = (*TURNING, "fixed", "prismatic", "planar", "floating")
_SIX = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def read_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
) -> SelfModel:
    """The self model of a URDF file.

    Args:
        path: of the file.
        joints: names of the joints wanted; all others are locked at zero with a warning. None:
            every revolute and continuous joint (prismatic and mimicking ones locked with a
            warning). The model's order is that of the tree, parents first.
        floating: whether the base is free.
        gravity: (3,) acceleration of gravity in base axes, m/s²; [0 0 -9.81] where None.

    Raises:
        ModelError: one sentence naming the file, the element and the choices.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{path}: cannot be read as a URDF ({error})") from None
    return model_from_urdf(text, str(path), joints, floating, gravity)


def model_from_urdf(
    text: str,
    file: str = "URDF",
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
) -> SelfModel:
    """As `read_urdf`, from the text; `file` is what errors and provenance call it."""
    robot = parse_urdf(text, file)
    root = _root(robot)
    moving = _moving(robot, joints)
    merged = _Merge(robot, moving)
    merged.walk(root)
    if not merged.order:
        raise ModelError(f"{file}: no joint is left to move; have: {_names(robot.joints)}")
    merged.check_masses(floating)
    down = gravity_down() if gravity is None else vector3(gravity)
    return merged.model(floating, down)


def _names(joints: dict[str, UrdfJoint]) -> str:
    return ", ".join(f"{j.name} ({j.kind})" for j in joints.values()) or "no joints"


def _root(robot: UrdfRobot) -> str:
    """The one link that is nobody's child; every link must hang on it, by one joint."""
    parent_of: dict[str, UrdfJoint] = {}
    for joint in robot.joints.values():
        if joint.child in parent_of:
            both = f"'{parent_of[joint.child].name}' and '{joint.name}'"
            raise ModelError(
                f"{robot.file}: link '{joint.child}' is the child of joints {both}; a loop can't "
                "be read, remove one of them"
            )
        parent_of[joint.child] = joint
    roots = [name for name in robot.links if name not in parent_of]
    if len(roots) > 1:
        raise ModelError(
            f"{robot.file}: {len(roots)} root links ({', '.join(roots)}); a robot has one, join "
            "them with fixed joints"
        )
    for name in robot.links:
        seen = [name]
        while seen[-1] in parent_of:
            seen.append(parent_of[seen[-1]].parent)
            if seen[-1] in seen[:-1]:
                raise ModelError(
                    f"{robot.file}: links {' -> '.join(reversed(seen))} form a loop; a tree is "
                    "needed"
                )
    return roots[0]


def _moving(robot: UrdfRobot, wanted: Sequence[str] | None) -> set[str]:
    """Names of the joints that move in the model; warns about each that is locked."""
    turning = {j.name for j in robot.joints.values() if j.kind in TURNING}
    free = {name for name in turning if not robot.joints[name].mimic}
    chosen = free if wanted is None else set(wanted)
    for name in sorted(chosen):
        joint = robot.joints.get(name)
        if joint is None or joint.kind not in TURNING:
            fault = "is not there" if joint is None else f"is {joint.kind}"
            raise ModelError(
                f"{robot.file}: joint '{name}', asked for, {fault}; have turning joints: "
                f"{', '.join(j for j in robot.joints if j in turning)}"
            )
    for joint in robot.joints.values():
        if joint.name not in chosen and joint.kind != "fixed":
            follows = " and mimics another" if joint.mimic else ""
            warnings.warn(
                f"{robot.file}: joint '{joint.name}' is {joint.kind}{follows}; locked at zero",
                ModelWarning,
                stacklevel=4,
            )
    return chosen


@dataclass
class _Body:
    """A moving link (or the base) while the file is walked; frames turned as the rule says."""

    name: str
    parent: int
    joint: UrdfJoint | None
    rotation: Array
    position: Array
    theta: Array
    merged: list[str] = field(default_factory=list)


class _Merge:
    """Walks the links depth first, in the file's order, and merges what does not move."""

    def __init__(self, robot: UrdfRobot, moving: set[str]) -> None:
        self.robot = robot
        self.moving = moving
        self.base: _Body | None = None
        self.order: list[_Body] = []
        self.frames: list[FixedFrame] = []
        self.children: dict[str, list[UrdfJoint]] = {name: [] for name in robot.links}
        for joint in robot.joints.values():
            self.children[joint.parent].append(joint)

    def walk(self, root: str) -> None:
        """Fill `base`, `order` and `frames` from the root link on."""
        eye, zero = np.eye(3), np.zeros(3)
        self.base = _Body(root, BASE, None, eye, zero, self.robot.links[root])
        # Joints still to visit, the number of the body they hang on, and the placement in it of
        # the URDF frame of the link they hang on.
        todo = [(joint, BASE, eye, zero) for joint in reversed(self.children[root])]
        while todo:
            joint, number, rotation, position = todo.pop()
            rotation, position = rotation @ joint.rotation, position + rotation @ joint.position
            number, rotation, position = self._visit(joint, number, rotation, position)
            below = reversed(self.children[joint.child])
            todo += [(child, number, rotation, position) for child in below]

    def _visit(self, joint: UrdfJoint, number: int, r: Array, p: Array) -> tuple[int, Array, Array]:
        """Take in the child of a joint at (r, p) in body `number`: its body and placement there."""
        theta = self.robot.links[joint.child]
        if joint.name in self.moving:
            turn = z_to_axis(joint.axis)
            turned = turned_theta(theta, turn.T)
            self.order.append(_Body(joint.child, number, joint, r @ turn, p, turned))
            return len(self.order) - 1, turn.T, np.zeros(3)
        body = self._body(number)
        body.theta = body.theta + move_theta(theta, r, p)
        body.merged.append(joint.child)
        self.frames.append(FixedFrame(joint.child, joint.name, body.name, r, p))
        return number, r, p

    def _body(self, number: int) -> _Body:
        assert self.base is not None
        return self.base if number == BASE else self.order[number]

    def check_masses(self, floating: bool) -> None:
        """Refuse a moving body without mass: no motion of it could be explained."""
        for body in [self._body(BASE), *self.order] if floating else self.order:
            if body.theta[0] <= 0.0:
                rest = f" (with {', '.join(body.merged)})" if body.merged else ""
                joint = f"leave joint '{body.joint.name}' out" if body.joint else "fix the base"
                raise ModelError(
                    f"{self.robot.file}: moving link '{body.name}'{rest} has no mass; give it an "
                    f"<inertial> or {joint}"
                )

    def model(self, floating: bool, gravity: Array) -> SelfModel:
        """The self model of what was walked."""
        base, order = self._body(BASE), self.order
        joints = [body.joint for body in order if body.joint is not None]
        tree = Tree(
            tuple(body.parent for body in order),
            floating,
            tuple(joint.name for joint in joints),
            tuple(body.name for body in order),
            base.name,
        )
        theta = np.stack([body.theta for body in order])
        return SelfModel(
            name=self.robot.name,
            tree=tree,
            lam=np.stack([np.r_[zxz_from_matrix(b.rotation), b.position] for b in order]),
            theta=np.vstack([base.theta, theta]) if floating else theta,
            base_theta=np.zeros(10) if floating else base.theta,
            limits=Limits(*np.stack([joint.limits for joint in joints], axis=1)),
            axis=np.stack([joint.axis for joint in joints]),
            frames=tuple(self.frames),
            gravity=gravity,
            provenance={"urdf": Path(self.robot.file).name},
        )


@dataclass(frozen=True)
class UrdfJoint:
    """A joint as written: placement in the parent link's frame, axis in its own.

    `limits` are [lower upper velocity effort], NaN where not given.
    """

    name: str
    kind: str
    parent: str
    child: str
    rotation: Array
    position: Array
    axis: Array
    limits: Array
    mimic: bool


@dataclass(frozen=True)
class UrdfRobot:
    """A file's content: θ (10,) of each link in its own frame, and the joints, as written."""

    file: str
    name: str
    links: dict[str, Array]
    joints: dict[str, UrdfJoint]


def parse_urdf(text: str, file: str) -> UrdfRobot:
    """Links and joints of a URDF; `file` is what errors call it.

    Raises:
        ModelError: naming the file, the element and what is wrong with it.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelError(f"{file}: not XML ({error})") from None
    if root.tag != "robot":
        raise ModelError(f"{file}: top element is <{root.tag}>, a URDF has <robot>")
    links: dict[str, Array] = {}
    for element in root.findall("link"):
        name = _attribute(element, "name", file, "a <link>")
        if name in links:
            raise ModelError(f"{file}: link '{name}' appears twice")
        links[name] = _link_theta(element, f"{file}: link '{name}'")
    joints: dict[str, UrdfJoint] = {}
    for element in root.findall("joint"):
        joint = _joint(element, links, file)
        if joint.name in joints:
            raise ModelError(f"{file}: joint '{joint.name}' appears twice")
        joints[joint.name] = joint
    if not links:
        raise ModelError(f"{file}: no <link> in it")
    return UrdfRobot(file, root.get("name", "robot"), links, joints)


def _attribute(element: ET.Element, key: str, file: str, what: str) -> str:
    value = element.get(key)
    if not value:
        raise ModelError(f"{file}: {what} has no '{key}' attribute")
    return value


def _numbers(text: str, count: int, where: str) -> Array:
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        raise ModelError(f"{where} must hold numbers, got '{text}'") from None
    if len(values) != count or not np.all(np.isfinite(values)):
        raise ModelError(f"{where} must hold {count} finite number(s), got '{text}'")
    return values


def _number(element: ET.Element, key: str, where: str) -> float:
    value = element.get(key)
    if value is None:
        raise ModelError(f"{where} has no '{key}' in its <{element.tag}>")
    return float(_numbers(value, 1, f"{where}, <{element.tag} {key}>")[0])


def _origin(element: ET.Element, where: str) -> tuple[Array, Array]:
    """Rotation (3, 3) and position (3,) of an <origin>; the identity where there is none."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    position = _numbers(origin.get("xyz", "0 0 0"), 3, f"{where}, <origin xyz>")
    rpy = _numbers(origin.get("rpy", "0 0 0"), 3, f"{where}, <origin rpy>")
    return matrix_from_rpy(rpy), position


def _link_theta(element: ET.Element, where: str) -> Array:
    """θ (10,) of a link about its own frame; zeros without <inertial>."""
    inertial = element.find("inertial")
    if inertial is None:
        return np.zeros(10)
    mass, tensor = inertial.find("mass"), inertial.find("inertia")
    if mass is None or tensor is None:
        missing = "mass" if mass is None else "inertia"
        raise ModelError(f"{where} has an <inertial> without <{missing}>")
    kilograms = _number(mass, "value", where)
    if kilograms < 0:
        raise ModelError(f"{where} has a negative mass of {kilograms} kg")
    about_com = tensor_from_six([_number(tensor, key, where) for key in _SIX])
    rotation, com = _origin(inertial, where)
    return move_theta(theta_from_body(kilograms, np.zeros(3), about_com), rotation, com)


def _joint(element: ET.Element, links: dict[str, Array], file: str) -> UrdfJoint:
    name = _attribute(element, "name", file, "a <joint>")
    where = f"{file}: joint '{name}'"
    kind = _attribute(element, "type", file, f"joint '{name}'")
    if kind not in JOINT_TYPES:
        raise ModelError(f"{where} is of type '{kind}'; have: {', '.join(JOINT_TYPES)}")
    ends = {}
    for end in ("parent", "child"):
        found = element.find(end)
        link = None if found is None else found.get("link")
        if not link:
            raise ModelError(f"{where} has no <{end} link=...>")
        if link not in links:
            raise ModelError(f"{where} names {end} '{link}'; have links: {', '.join(links)}")
        ends[end] = link
    rotation, position = _origin(element, where)
    axis = _axis(element, where) if kind in TURNING else np.array([1.0, 0.0, 0.0])
    return UrdfJoint(
        name, kind, ends["parent"], ends["child"], rotation, position, axis,
        _limits(element, kind, where), element.find("mimic") is not None,
    )  # fmt: skip


def _axis(element: ET.Element, where: str) -> Array:
    """The unit axis (3,); URDF's default is x."""
    found = element.find("axis")
    if found is None:
        return np.array([1.0, 0.0, 0.0])
    value = _attribute(found, "xyz", where, "its <axis>")
    axis = _numbers(value, 3, f"{where}, <axis xyz>")
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise ModelError(f"{where} has an axis of length zero")
    # An axis that is a unit vector already keeps its digits.
    return axis if abs(length - 1.0) < 1e-15 else axis / length


def _limits(element: ET.Element, kind: str, where: str) -> Array:
    found = element.find("limit")
    out = np.full(4, math.nan)
    if found is None:
        return out
    # A continuous joint has no position limits, whatever its file says.
    keys = (
        ("velocity", "effort") if kind == "continuous" else ("lower", "upper", "velocity", "effort")
    )
    for key in keys:
        if found.get(key) is not None:
            place = ("lower", "upper", "velocity", "effort").index(key)
            out[place] = _number(found, key, where)
    return out
