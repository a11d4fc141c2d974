"""Triangles from STL and OBJ files, and which file a URDF means by a name.

A file may be damaged or meant to do harm: sizes are bounded, every number is looked at, and what
is wrong is said in one sentence.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from adapter.model.spatial import Array
from drivers.files.bounded import read_bytes

FORMATS = ".stl, .obj"
MOST_TRIANGLES = 200_000  # some 30 MB with the search tree over them
MOST_BYTES = 2**25  # of a file
INTEGER_DIGITS = 12  # of a corner's number; what is longer is none
FURTHEST_M = 100.0  # from the mesh's origin; what is larger was drawn in millimetres
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
        content = read_bytes(path, MOST_BYTES)
        if path.suffix.lower() == ".stl":
            corners, triangles = _stl(content)
        elif path.suffix.lower() == ".obj":
            corners, triangles = _obj(content)
        else:
            raise ValueError(f"meshes are read from {FORMATS}; convert it")
        corners = corners * np.asarray(scale, dtype=np.float64)
        _check(corners, triangles)
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


def _check(corners: Array, triangles: NDArray[np.int64]) -> None:
    if not len(triangles):
        raise ValueError("has no triangles")
    if triangles.min() < 0 or triangles.max() >= len(corners):
        raise ValueError("a triangle has a corner that the file does not have")
    if not np.isfinite(corners).all():
        raise ValueError("a corner is not a finite number")
    if (far := float(np.abs(corners).max())) > FURTHEST_M:
        raise ValueError(f"is {far:g} m large; a scale of 0.001 makes metres of millimetres")


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
        number = int(part.split(b"/")[0][:INTEGER_DIGITS])
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
