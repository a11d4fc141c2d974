"""The room that an arm takes: bodies on its links, as small as what is known of them allows.

In this order: capsules of an arm that is known by name; capsules around the boxes, cylinders and
spheres of a URDF's collision elements, and the convex hulls of its meshes; capsules from a joint to
the next with a radius that the inertia says, also where the file of a mesh is not to be had.

Meshes are triangles from STL and OBJ files. A file may be damaged or meant to do harm: sizes are
bounded, every number is looked at, and what is wrong is said in one sentence.
"""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from adapter.control.settings import Hand
from adapter.errors import ModelWarning
from adapter.model.inertia import body_from_theta
from adapter.model.locking import LOCKED
from adapter.model.robot_file import Merged
from adapter.model.robots import facts_of
from adapter.model.self_model import URDF, SelfModel, Source
from adapter.model.spatial import Array
from adapter.model.tree import BASE
from adapter.model.urdf import origin_of, parse_urdf
from drivers.files.bounded import read_bytes

FORMATS = ".stl, .obj"
MOST_TRIANGLES = 200_000  # some 30 MB with the search tree over them
HEADER_BYTES, RECORD = 80, np.dtype([("normal", "<f4", 3), ("at", "<f4", (3, 3)), ("more", "<u2")])
PACKAGE, FILE = "package://", "file://"
LEVELS = 8  # folders above a URDF that a package is looked for in


@dataclass(frozen=True)
class Mesh:
    """Triangles: corners (k, 3), m, and three numbers of corners for each (m, 3)."""

    corners: Array
    triangles: NDArray[np.int64]


def read_mesh(path: str | Path, scale: tuple[float, ...] = (1.0,)) -> Mesh:
    """The triangles of an STL (binary or text) or OBJ file.

    Args:
        path: of the file.
        scale: metres per unit of the file, one number or one for each axis.

    Raises:
        ValueError: what is wrong with it, in one sentence that begins with the path.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        content = read_bytes(path, 2**25)  # of a file
        if path.suffix.lower() == ".stl":
            corners, triangles = _stl(content)
        elif path.suffix.lower() == ".obj":
            corners, triangles = _obj(content)
        else:
            raise ValueError(f"meshes are read from {FORMATS}; convert it")
        corners = corners * np.asarray(scale, dtype=np.float64)
        if not len(triangles):
            raise ValueError("has no triangles")
        if triangles.min() < 0 or triangles.max() >= len(corners):
            raise ValueError("a triangle has a corner that the file does not have")
        if not np.isfinite(corners).all():
            raise ValueError("a corner is not a finite number")
        if (far := float(np.abs(corners).max())) > 100.0:  # m
            raise ValueError(f"is {far:g} m large; a scale of 0.001 makes metres of millimetres")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Mesh(corners, triangles)


def hull_of(mesh: Mesh) -> Mesh:
    """The convex hull, with the corners that lie on it alone. Raises ValueError for a flat one."""
    try:
        hull = ConvexHull(mesh.corners)
    except QhullError:
        raise ValueError("all its corners lie in one plane; a link needs a body") from None
    new = np.full(len(mesh.corners), -1)
    new[hull.vertices] = np.arange(len(hull.vertices))
    return Mesh(mesh.corners[hull.vertices], new[hull.simplices].astype(np.int64))


def file_of(name: str, folder: str) -> Path:
    """The file that a URDF in `folder` means by `package://NAME/...`, `file://...` or a path.

    A package is the nearest folder of its name that the URDF lies in, beside or below, or one in
    ROS_PACKAGE_PATH. Any other file has to lie in the URDF's package (where a `package.xml` is),
    or, without one, in the folder above the URDF's.

    Raises:
        ValueError: there is none, or it lies elsewhere.
    """
    here = Path(folder).resolve()
    if name.startswith(PACKAGE):
        package, _, rest = name.removeprefix(PACKAGE).partition("/")
        above = [here, *here.parents][:LEVELS]
        places = [at for at in above if at.name == package] + [at / package for at in above]
        listed = os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)
        for at in map(Path, filter(None, listed)):  # a package, or the folder of packages
            places += [at, at / package] if at.name == package else [at / package]
        for root in places:
            if (found := root / rest).is_file():
                return _inside(found, root, name)
        raise ValueError(
            f"{name}: no folder '{package}' with that file around the URDF; put it beside the "
            "URDF, or its folder into ROS_PACKAGE_PATH"
        )
    found = here / name.removeprefix(FILE)
    packages = [at for at in [here, *here.parents][:LEVELS] if (at / "package.xml").is_file()]
    found = _inside(found, packages[0] if packages else here.parent, name)
    if not found.is_file():
        raise ValueError(f"{name}: no such file beside the URDF")
    return found


def _inside(found: Path, root: Path, name: str) -> Path:
    found, root = found.resolve(), root.resolve()
    if not found.is_relative_to(root):
        raise ValueError(f"{name}: lies outside of {root}; it is not read")
    return found


def _stl(content: bytes) -> tuple[Array, NDArray[np.int64]]:
    count = int.from_bytes(content[HEADER_BYTES : HEADER_BYTES + 4], "little")
    body = len(content) - HEADER_BYTES - 4
    if body == count * RECORD.itemsize and body >= 0:
        _few(count)
        at = np.frombuffer(content, RECORD, count, HEADER_BYTES + 4)["at"].reshape(-1, 3)
    elif content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:4096]:
        if b"endsolid" not in content[-4096:]:
            raise ValueError("ends before its endsolid: it was cut off")
        parts = content.split(b"vertex")[1:]
        _few(len(parts) // 3)
        at = np.array([_numbers(part.split(None, 3)[:3]) for part in parts])
        if not len(at) or len(at) % 3:
            raise ValueError("its corners do not come in threes")
    else:
        raise ValueError(
            f"says {count} triangles, which take {count * RECORD.itemsize} bytes, and has "
            f"{max(body, 0)}: it was cut off, or is no STL"
        )
    corners, number = np.unique(np.asarray(at).astype(np.float64), axis=0, return_inverse=True)
    return corners, number.reshape(-1, 3).astype(np.int64)


def _obj(content: bytes) -> tuple[Array, NDArray[np.int64]]:
    corners: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for line in content.splitlines():
        kind, *parts = line.split() or [b""]
        if kind == b"v":
            corners.append(_numbers(parts[:3]))
            _few(len(corners) // 3)
        elif kind == b"f":
            _few(len(triangles) + len(parts))
            face = [_corner(part, len(corners)) for part in parts]
            triangles += [(face[0], b, c) for b, c in pairwise(face[1:])]
    return np.array(corners).reshape(-1, 3), np.array(triangles, np.int64).reshape(-1, 3)


def _corner(part: bytes, count: int) -> int:
    """The corner's number from 0; negative ones count from the last one before."""
    try:
        number = int(part.split(b"/")[0][:12])  # longer, it is none
    except ValueError:
        raise ValueError(f"a face has the corner {part[:20]!r}, which is no number") from None
    return number - 1 if number > 0 else count + number


def _numbers(parts: list[bytes]) -> list[float]:
    try:
        x, y, z = map(float, parts)
    except ValueError:
        said = b" ".join(parts)[:40].decode(errors="replace")
        raise ValueError(f"a corner is '{said}'; it has 3 numbers") from None
    return [x, y, z]


def _few(count: int) -> None:
    """Refuse early, before the memory is taken."""
    if count > MOST_TRIANGLES:
        raise ValueError(
            f"has {count} triangles or more; at most {MOST_TRIANGLES} are read, simplify it"
        )


THINNEST_M, THICKEST_M = 0.03, 0.15  # radius that an inertia may say


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
            far = np.linalg.norm(frame.position) > reach + 0.02  # m
            if frame.parent == model.tree.link_names[link] and far:
                yield Body(link, np.array([np.zeros(3), frame.position]), 0.1)  # m


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
            turn, place = origin_of(collision, f"{source.file}: <collision>")
            R, p = R_link @ turn, p_link + R_link @ place
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
