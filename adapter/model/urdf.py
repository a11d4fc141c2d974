"""URDF into a self model (see `robot_file` for the rule of the axes), and a learned one back."""

from __future__ import annotations

import math
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from adapter.errors import ModelError, ModelWarning
from adapter.model.inertia import body_from_theta, move_theta, tensor_from_six, theta_from_body
from adapter.model.onto import SAME, changes_onto
from adapter.model.robot_file import MOVING, FileJoint, FileRobot, Merged
from adapter.model.self_model import LIMITS, URDF, SelfModel, Source, check_limits, gravity_down
from adapter.model.spatial import Array, matrix_from_rpy, rpy_from_matrix, vector3
from adapter.model.urdf_text import NO_INERTIA, SIX, Additions, number_text, six_named
from adapter.model.xml_edit import Element, XmlText
from drivers.files.bounded import read_text

JOINT_TYPES = (*MOVING, "fixed", "planar", "floating")


def read_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
    lock: Mapping[str, float] | None = None,
) -> SelfModel:
    """The self model of a URDF file.

    Args:
        path: of the file.
        joints: names of the joints wanted; all others are locked at zero with a warning. None:
            every joint that turns or slides, but for a gripper's and those that mimic (locked
            with a warning). The model's order is that of the tree, parents first.
        floating: whether the base is free.
        gravity: (3,) acceleration of gravity in base axes, m/s²; [0 0 -9.81] where None.
        lock: values of joints to be locked, rad, and m of prismatic ones; those that mimic a
            locked joint follow it.

    Raises:
        ModelError: one sentence naming the file, the element and the choices.
    """
    text = file_text(path)
    model = model_from_urdf(text, str(path), joints, floating, gravity, lock)
    assert model.source is not None
    source = replace(model.source, folder=str(Path(path).resolve().parent))
    return replace(model, source=source)


def model_from_urdf(
    text: str,
    file: str = "URDF",
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
    lock: Mapping[str, float] | None = None,
) -> SelfModel:
    """As `read_urdf`, from the text; `file` is what errors and provenance call it."""
    merged = Merged(parse_urdf(text, file), joints, lock)
    down = gravity_down() if gravity is None else vector3(gravity)
    return merged.model(floating, down)


def file_text(path: str | Path) -> str:
    """A file's text, its line ends as they are. Raises ModelError."""
    try:
        return read_text(path)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise ModelError(f"{path}: {error}") from None


def parse_urdf(text: str, file: str) -> FileRobot:
    """Links and joints of a URDF; `file` is what errors call it.

    Raises:
        ModelError: naming the file, the element and what is wrong with it.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelError(f"{file}: not XML ({error})") from None
    own = root.tag.rpartition("}")[0] + "}" if root.tag.startswith("{") else ""
    for element in root.iter():  # without the namespace that a file may give all of it
        element.tag = element.tag.removeprefix(own)
    if root.tag != "robot":
        raise ModelError(f"{file}: top element is <{root.tag}>, a URDF has <robot>")
    links: dict[str, Array] = {}
    for element in root.findall("link"):
        name = _attribute(element, "name", file, "a <link>")
        if name in links:
            raise ModelError(f"{file}: link '{name}' appears twice")
        links[name] = _link_theta(element, f"{file}: link '{name}'")
    joints: dict[str, FileJoint] = {}
    for element in root.findall("joint"):
        joint = _joint(element, links, file)
        if joint.name in joints:
            raise ModelError(f"{file}: joint '{joint.name}' appears twice")
        joints[joint.name] = joint
    _stated(joints.values(), file)
    if not joints and any("xacro}" in element.tag for element in root):
        raise ModelError(f"{file}: is xacro yet; make a URDF of it first: xacro FILE > arm.urdf")
    if not links:
        raise ModelError(f"{file}: no <link> in it")
    source = Source(URDF, Path(file).name, text)
    return FileRobot(file, root.get("name", "robot"), links, joints, source)


_parsed = lru_cache(maxsize=1)(parse_urdf)  # of the many models that are written onto one file


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


def origin_of(element: ET.Element, where: str) -> tuple[Array, Array]:
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
    about_com = tensor_from_six([_number(tensor, key, where) for key in SIX])
    rotation, com = origin_of(inertial, where)
    return move_theta(theta_from_body(kilograms, np.zeros(3), about_com), rotation, com)


def _joint(element: ET.Element, links: dict[str, Array], file: str) -> FileJoint:
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
    rotation, position = origin_of(element, where)
    axis = _axis(element, where) if kind in MOVING else np.array([1.0, 0.0, 0.0])
    limits, followed, mimic = _limits(element, kind, where), element.find("mimic"), None
    if followed is not None:
        factor, offset = (
            usual if followed.get(key) is None else _number(followed, key, where)
            for key, usual in (("multiplier", 1.0), ("offset", 0.0))
        )
        mimic = followed.get("joint", ""), factor, offset
    return FileJoint(
        name, kind, ends["parent"], ends["child"], rotation, position, axis, limits, mimic
    )


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
    found, out = element.find("limit"), np.full(4, math.nan)
    if found is not None:
        for place, key in enumerate(LIMITS):
            # a continuous joint has no position limits, whatever its file says
            if found.get(key) is not None and (kind != "continuous" or key in LIMITS[2:]):
                out[place] = _number(found, key, where)
    return out


def _stated(joints: Iterable[FileJoint], file: str) -> None:
    """Check limits; a speed or effort of 0 is what many files write for one that nobody knows."""
    silent = []
    for joint in joints:
        if joint.kind in MOVING:
            zero = joint.limits[2:] == 0.0
            silent += [joint.name] * bool(zero.any())
            joint.limits[2:][zero] = math.nan
            check_limits(joint.limits.tolist(), f"{file}: joint '{joint.name}'")
    if silent:
        said = f"{file}: a limit of 0 for the speed or effort of {', '.join(silent)} says nothing"
        warnings.warn(f"{said}; it is taken as not known", ModelWarning, stacklevel=4)


def urdf_onto(model: SelfModel, more: Additions, text: str, file: str) -> tuple[str, list[str]]:
    """The URDF with what was learned in it, no other byte changed, and notes on it in words.

    Inertials, joint origins and <dynamics> change, and these only where their numbers do. A link
    without <inertial> gets one of no mass: PyBullet would give it 1 kg.

    Args:
        model: the arm; more: what it has beside, `places` being `URDF_PLACES`.
        text: of the URDF; file: what errors call it.

    Raises:
        ModelError: as `onto.changes_onto`.
    """
    robot = _parsed(text, file)
    changes = changes_onto(model, more, robot)
    xml = XmlText(text, file)
    joints = {x.attributes["name"]: x for x in xml.root.children if x.tag == "joint"}
    links = {x.attributes["name"]: x for x in xml.root.children if x.tag == "link"}
    for name, (rotation, position) in changes.origins.items():
        _write_origin(xml, joints[name], position, rotation)
    for name, theta in changes.bodies.items():
        _write_inertial(xml, links[name], theta)
    for name, values in changes.joints.items():
        dynamics = joints[name].child("dynamics")
        lost = " ".join(f'{key}="{number_text(x)}"' for key, x in values.items() if x)
        if dynamics is not None:
            for key, value in values.items():
                _put(xml, dynamics, key, value, 0.0)
        elif lost:
            xml.insert(joints[name], f"<dynamics {lost}/>")
    ridden = set(links) if model.tree.floating else {j.child for j in robot.joints.values()}
    for name in ridden - set(changes.bodies):
        if links[name].child("inertial") is None:
            xml.insert(links[name], NO_INERTIA)
    return xml.text(), changes.notes


def _write_origin(
    xml: XmlText, element: Element, position: Array, rotation: Array | None = None
) -> None:
    """<origin> of an element; its orientation stays where None."""
    origin = element.child("origin")
    if origin is None:
        rpy = "" if rotation is None else f' rpy="{number_text(rpy_from_matrix(rotation))}"'
        xml.insert(element, f'<origin xyz="{number_text(position)}"{rpy}/>')
        return
    _put(xml, origin, "xyz", position, 1.0)
    if rotation is not None:
        now = matrix_from_rpy(_array(origin.attributes.get("rpy", "0 0 0")))
        if np.abs(now - rotation).max() > SAME:
            xml.set(origin, "rpy", number_text(rpy_from_matrix(rotation)))


def _write_inertial(xml: XmlText, link: Element, theta: Array) -> None:
    """A link's body (10,) in its frame; the axes of its tensor stay those of the file."""
    mass, com, tensor = body_from_theta(theta)
    inertial = link.child("inertial")
    if inertial is None:
        six = " ".join(f'{key}="{number_text(x)}"' for key, x in six_named(tensor).items())
        centre, mass_kg = number_text(com), number_text(mass)
        inside = f'<origin xyz="{centre}"/>\n  <mass value="{mass_kg}"/>\n  <inertia {six}/>'
        xml.insert(link, f"<inertial>\n  {inside}\n</inertial>")
        return
    origin, axes = inertial.child("origin"), np.eye(3)
    if origin is not None:
        axes = matrix_from_rpy(_array(origin.attributes.get("rpy", "0 0 0")))
    _write_origin(xml, inertial, com)
    weight, inertia = inertial.child("mass"), inertial.child("inertia")
    assert weight is not None and inertia is not None  # `parse_urdf` has read them
    _put(xml, weight, "value", mass, float(mass))
    for key, value in six_named(axes.T @ tensor @ axes).items():
        _put(xml, inertia, key, value, float(np.trace(tensor)))


def _put(xml: XmlText, element: Element, key: str, value: ArrayLike, scale: float) -> None:
    """Give an attribute its numbers; where it has them but for rounding of a scale, it stays."""
    now = element.attributes.get(key)
    if now is None or not np.abs(np.subtract(_array(now), value)).max() <= SAME * scale:
        xml.set(element, key, number_text(np.asarray(value)))


def _array(text: str) -> Array:
    return np.array(text.split(), dtype=np.float64)
