"""The room that an arm takes: bodies on its links, as small as what is known of them allows.

In this order: capsules of an arm that is known by name; capsules around the boxes, cylinders and
spheres of a URDF's collision elements, and the convex hulls of its meshes; capsules from a joint to
the next with a radius that the inertia says, also where the file of a mesh is not to be had.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapter.control.cell import Hand
from adapter.control.meshes import Mesh, file_of, hull_of, read_mesh
from adapter.errors import ModelWarning
from adapter.model.inertia import body_from_theta
from adapter.model.locking import LOCKED
from adapter.model.robot_file import Merged
from adapter.model.robots.known import facts_of
from adapter.model.self_model import URDF, SelfModel, Source
from adapter.model.spatial import Array, matrix_from_rpy
from adapter.model.tree import BASE
from adapter.model.urdf import parse_urdf

THINNEST_M, THICKEST_M = 0.03, 0.15  # radius that an inertia may say
HAND_RADIUS_M = 0.1  # of a hand on an arm that is known by name: Franka's is 0.2 m wide
ENOUGH_M = 0.02  # beyond the known shapes, a frame on the hand says that something is there


@dataclass(frozen=True)
class Body:
    """All within `radius` of a line between two points (a capsule), or of a mesh's convex hull.

    The hull fills hollows: on the safe side.

    Attributes:
        link: number of the link that it is on, -1 for the base.
        ends: (2, 3) of the line, or (k, 3) corners of the hull, in that link's frame, m.
        triangles: (m, 3) numbers of three corners each; None of a capsule.
    """

    link: int
    ends: Array
    radius: float = 0.0
    triangles: NDArray[np.int64] | None = None


def bodies_of(model: SelfModel, hand: Hand | None = None) -> list[Body]:
    """What the links of an arm with a fixed base are taken for.

    Warns (ModelWarning) of each mesh that cannot be used, and why.
    """
    known = facts_of(model)
    found: list[Body]
    if known is not None:
        found = [
            Body(number - 1, row[:6].reshape(2, 3), float(row[6]))
            for number, rows in known.capsules.items()
            for row in rows
        ]
        found += _on_the_hand(model, found)
    else:
        found, lacking = _of_collisions(model)
        bare = set(range(BASE, model.tree.n)) - {body.link for body in found} | lacking
        found += [capsule for link in sorted(bare) for capsule in _of_inertia(model, link)]
    if hand is not None:
        ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, hand.length]])
        found += [Body(link, ends, hand.radius) for link in leaves(model)]
    return found


def leaves(model: SelfModel) -> list[int]:
    """Links that carry no other."""
    return [link for link in range(model.tree.n) if link not in model.tree.parent]


def _on_the_hand(model: SelfModel, known: list[Body]) -> Iterator[Body]:
    """Room for what a file hangs on the flange of an arm whose own shapes are known."""
    for link in leaves(model):
        reach = max(np.abs(c.ends).max() + c.radius for c in known if c.link == link)
        for frame in model.frames:
            far = np.linalg.norm(frame.position) > reach + ENOUGH_M
            if frame.parent == model.tree.link_names[link] and far:
                yield Body(link, np.array([np.zeros(3), frame.position]), HAND_RADIUS_M)


def _of_collisions(model: SelfModel) -> tuple[list[Body], set[int]]:
    """Bodies of a URDF's collision elements, and the links that lack one of theirs."""
    source = model.source
    found: list[Body] = []
    lacking: set[int] = set()
    if source is None or source.format != URDF or source.text is None:
        return found, lacking
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # they were said when the model was read
        locked = model.provenance.get(LOCKED) or {}
        merged = Merged(parse_urdf(source.text, source.file), model.tree.joint_names, locked)
    root = ET.fromstring(source.text)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    for link in root.findall("link"):
        body, R_link, p_link = merged.place[link.get("name", "")]
        for collision in link.findall("collision"):
            shape = collision.find("geometry/*")
            origin = collision.find("origin")
            place = np.zeros(6) if origin is None else _six(origin)
            R, p = R_link @ matrix_from_rpy(place[3:]), p_link + R_link @ place[:3]
            line = None if shape is None else _line_of(shape)
            if line is not None:
                ends = np.array([p - R @ line[0], p + R @ line[0]])
                found.append(Body(body, ends, line[1]))
            elif shape is not None and shape.tag == "mesh":
                mesh = _mesh_of(shape, source, link.get("name", ""))
                if mesh is None:
                    lacking.add(body)
                else:
                    found.append(Body(body, p + mesh.corners @ R.T, triangles=mesh.triangles))
    return found, lacking


def _mesh_of(shape: ET.Element, source: Source, link: str) -> Mesh | None:
    """The hull of a mesh element; None, with a warning, where its file cannot be used."""
    name = shape.get("filename", "")
    try:
        if source.folder is None:
            raise ValueError(f"{name}: the folder of {source.file} is not known")
        scale = tuple(float(part) for part in shape.get("scale", "1 1 1").split())
        if len(scale) != 3 or not np.isfinite(scale).all() or not all(scale):
            raise ValueError(f"{name}: scale needs 3 numbers that are not zero")
        return hull_of(read_mesh(file_of(name, source.folder), scale))
    except ValueError as error:
        warnings.warn(
            f"link '{link}': its mesh is not used ({error}); a capsule by its inertia is",
            ModelWarning,
            stacklevel=2,
        )
        return None


def _six(origin: ET.Element) -> Array:
    texts = origin.get("xyz", "0 0 0"), origin.get("rpy", "0 0 0")
    return np.array([float(part) for text in texts for part in text.split()])


def _line_of(shape: ET.Element) -> tuple[Array, float] | None:
    """Half of the line (3,) and the radius of the capsule around a shape; None for a mesh."""
    if shape.tag == "sphere":
        return np.zeros(3), float(shape.get("radius", "0"))
    if shape.tag == "cylinder":
        return np.array([0.0, 0.0, 0.5 * float(shape.get("length", "0"))]), float(
            shape.get("radius", "0")
        )
    if shape.tag == "box":
        half = 0.5 * np.array([float(part) for part in shape.get("size", "0 0 0").split()])
        longest = np.where(np.arange(3) == np.argmax(half), half, 0.0)
        return longest, float(np.linalg.norm(half - longest))
    return None


def _of_inertia(model: SelfModel, link: int) -> Iterator[Body]:
    """Capsules from a link's joint to the joints that it carries, or through its centre of mass.

    The radius is that of a solid cylinder with the link's inertia about the line.
    """
    theta = model.base_theta if link == BASE else model.theta[link]
    mass, com, inertia = body_from_theta(theta) if theta[0] > 0.0 else (0.0, np.zeros(3), None)
    children = [k for k, parent in enumerate(model.tree.parent) if parent == link]
    ends = [model.lam[k, 3:] for k in children]
    if not children:
        name = model.tree.link_names[link]
        ends = [frame.position for frame in model.frames if frame.parent == name] or [2.0 * com]
        ends = [max(ends, key=lambda end: float(np.linalg.norm(end)))]
    for end in ends:
        length = float(np.linalg.norm(end))
        radius = THINNEST_M
        if inertia is not None and length > 0.0:
            about = float(end @ inertia @ end) / length**2
            radius = float(np.clip(np.sqrt(2.0 * about / mass), THINNEST_M, THICKEST_M))
        yield Body(link, np.array([np.zeros(3), end]), radius)
