"""The cell that an arm stands in, as settings: what it must not touch. In base axes, m and rad.

[cell]
margin = 0.05
[[cell.box]]
name = "shelf"
size = [0.4, 1.0, 0.05]
xyz = [0.6, 0.0, 0.4]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from adapter.errors import SettingsError

LEAST_MARGIN_M = 0.01


def _need(condition: bool, name: str, what: str) -> None:
    if not condition:
        raise SettingsError(f"cell, '{name}': {what}")


def _finite(values: tuple[float, ...], count: int) -> bool:
    return len(values) == count and all(map(math.isfinite, values))


@dataclass(frozen=True)
class Box:
    """A box: side lengths along its own axes, place of its centre, turn about x, y, z."""

    name: str
    size: tuple[float, ...]
    xyz: tuple[float, ...]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        sides = _finite(self.size, 3) and min(self.size) > 0.0
        _need(sides, self.name, "size needs 3 lengths above zero")
        _need(_finite((*self.xyz, *self.rpy), 6), self.name, "xyz and rpy need 3 numbers each")


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along its own z, placed by its centre."""

    name: str
    radius: float
    length: float
    xyz: tuple[float, ...]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        sizes = 0.0 < self.radius < math.inf and 0.0 < self.length < math.inf
        _need(sizes, self.name, "radius and length must be above zero")
        _need(_finite((*self.xyz, *self.rpy), 6), self.name, "xyz and rpy need 3 numbers each")


@dataclass(frozen=True)
class Plane:
    """A wall or floor: all is free where normal . x > offset, for a normal of length 1."""

    name: str
    normal: tuple[float, ...]
    offset: float

    def __post_init__(self) -> None:
        _need(_finite((*self.normal, self.offset), 4), self.name, "normal needs 3 numbers")
        _need(math.hypot(*self.normal) > 0.0, self.name, "normal must not be zero")


@dataclass(frozen=True)
class Mesh:
    """The triangles of an STL or OBJ file, a surface: what is closed is not filled.

    `scale` is metres per unit of the file; xyz and rpy place the file's origin.
    """

    name: str
    file: str
    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        _need(0.0 < self.scale < math.inf, self.name, "scale must be above zero")
        _need(_finite((*self.xyz, *self.rpy), 6), self.name, "xyz and rpy need 3 numbers each")


@dataclass(frozen=True)
class Hand:
    """What is on the hand, from the last link's frame along its z."""

    length: float
    radius: float

    def __post_init__(self) -> None:
        sizes = 0.0 < self.radius < math.inf and 0.0 < self.length < math.inf
        _need(sizes, "hand", "length and radius must be above zero")


@dataclass(frozen=True)
class Cell:
    """Everything around an arm.

    Attributes:
        margin: kept from everything and between links.
        table: whether the arm stands on a plane: z = 0 of its base (on a wall, that wall).
        reach: furthest from the base's origin that any part may get; no limit where None.
        box, cylinder, plane, mesh: what stands there.
        hand: what the robot's file does not say of its hand.
        allowed: pairs of links, or of a link and a thing, that may touch.
    """

    margin: float = 0.05
    table: bool = True
    reach: float | None = None
    box: tuple[Box, ...] = ()
    cylinder: tuple[Cylinder, ...] = ()
    plane: tuple[Plane, ...] = ()
    mesh: tuple[Mesh, ...] = ()
    hand: Hand | None = None
    allowed: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        if not LEAST_MARGIN_M <= self.margin < math.inf:
            raise SettingsError(f"cell.margin must be at least {LEAST_MARGIN_M} m")
        if self.reach is not None and not self.reach > 0.0:
            raise SettingsError("cell.reach must be above zero")
        if any(len(pair) != 2 for pair in self.allowed):
            raise SettingsError("cell.allowed needs pairs of names")
        names = [each.name for each in self.box] + [each.name for each in self.cylinder]
        names += [each.name for each in self.plane] + [each.name for each in self.mesh]
        if len({*names, "table"}) <= len(names):
            raise SettingsError("cell: every box, cylinder, plane and mesh needs a name of its own")

    def beside(self, folder: Path) -> Cell:
        """The same cell, with files of meshes that are named from this folder."""
        return replace(
            self, mesh=tuple(replace(each, file=str(folder / each.file)) for each in self.mesh)
        )
