"""A learned model written onto the URDF it came from: numbers in their places, no other byte."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adapter.model.inertia import body_from_theta
from adapter.model.onto import SAME, changes_onto
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, matrix_from_rpy, rpy_from_matrix
from adapter.model.urdf import parse_urdf
from adapter.model.urdf_text import NO_INERTIA, Additions, number_text, six_named
from adapter.model.xml_edit import Element, XmlText


def urdf_onto(model: SelfModel, more: Additions, text: str, file: str) -> tuple[str, list[str]]:
    """The URDF with what was learned in it, and notes on it in words.

    Inertials, joint origins and <dynamics> change, and these only where their numbers do. A link
    without <inertial> gets one of no mass: PyBullet would give it 1 kg.

    Args:
        model: the arm; more: what it has beside, `places` being `URDF_PLACES`.
        text: of the URDF; file: what errors call it.

    Raises:
        ModelError: as `onto.changes_onto`.
    """
    robot = parse_urdf(text, file)
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
        now = matrix_from_rpy(_numbers(origin.attributes.get("rpy", "0 0 0")))
        if np.abs(now - rotation).max() > SAME:
            xml.set(origin, "rpy", number_text(rpy_from_matrix(rotation)))


def _write_inertial(xml: XmlText, link: Element, theta: Array) -> None:
    """A link's body (10,) in its frame; the axes of its tensor stay those of the file."""
    mass, com, tensor = body_from_theta(theta)
    inertial = link.child("inertial")
    if inertial is None:
        six = " ".join(f'{key}="{number_text(x)}"' for key, x in six_named(tensor).items())
        lines = (
            "<inertial>",
            f'  <origin xyz="{number_text(com)}"/>',
            f'  <mass value="{number_text(mass)}"/>',
            f"  <inertia {six}/>",
            "</inertial>",
        )
        xml.insert(link, "\n".join(lines))
        return
    origin, axes = inertial.child("origin"), np.eye(3)
    if origin is not None:
        axes = matrix_from_rpy(_numbers(origin.attributes.get("rpy", "0 0 0")))
    _write_origin(xml, inertial, com)
    weight, inertia = inertial.child("mass"), inertial.child("inertia")
    assert weight is not None and inertia is not None  # `parse_urdf` has read them
    _put(xml, weight, "value", mass, float(mass))
    for key, value in six_named(axes.T @ tensor @ axes).items():
        _put(xml, inertia, key, value, float(np.trace(tensor)))


def _put(xml: XmlText, element: Element, key: str, value: ArrayLike, scale: float) -> None:
    """Give an attribute its numbers; where it has them but for rounding of a scale, it stays."""
    now = element.attributes.get(key)
    if now is None or not np.allclose(_numbers(now), value, rtol=0.0, atol=SAME * scale):
        xml.set(element, key, number_text(np.asarray(value)))


def _numbers(text: str) -> Array:
    return np.array(text.split(), dtype=np.float64)
