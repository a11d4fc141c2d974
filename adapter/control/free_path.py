"""Whether a motion keeps clear of the cell and of the arm itself, all the way along its path.

Distances are coal's. Along the path a pair of bodies comes nearer at most as fast as the joints
between them turn, times how far away they turn it; from a distance d the next look is therefore
due only when d could have become the least one found, and nothing lies between two looks:

    |d(s) - d(s')| <= v_pair |s - s'|,   v_pair = sum_j max|q_j'| r_j

The path of a random motion depends on its path time alone, so stops and slow starts change nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.control.excitation import RandomMotion
from adapter.control.limits import MotionLimits
from adapter.control.path_motion import PathMotion
from adapter.control.settings import Cell, ExcitationSettings
from adapter.control.shapes import Body, Mesh, bodies_of, read_mesh
from adapter.errors import MeansError, SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, matrix_from_rpy, z_to_axis
from adapter.model.tree import BASE
from adapter.physics.kernels import frames_of, place_frames

TABLE, REACH = "table", "reach"
ATTEMPTS, SAME_SIZE, SHRINK = 48, 3, 0.8  # motions drawn, of one size, and the next size
POSES, ALWAYS = 100, 0.95  # two bodies that are near in so many of so many random poses are joined
SAME_START = 1e-3  # rad: from so near the same motion is free, too, to a millimetre or so
DIFFERENCE_RAD = 1e-4  # between two poses that a gradient is taken from

# From limits, where the arm is, settings, attempt and size.
Draw = Callable[[MotionLimits, Array, ExcitationSettings, int, float], PathMotion]


@dataclass(frozen=True)
class Clearance:
    """The least distance of a motion: m, between what, at which path time; inf where none is."""

    distance: float
    names: tuple[str, str]
    path_s: float

    def __str__(self) -> str:
        if not np.isfinite(self.distance):
            return "nothing that could touch"
        return f"{self.distance:.3f} m between {self.names[0]} and {self.names[1]}"


@dataclass(frozen=True)
class Pair:
    """Two bodies: one of the arm, and another or a thing in the cell (None: the limit of reach).

    Attributes:
        arms: (n,) m: how far away from both each joint may turn one against the other.
    """

    names: tuple[str, str]
    one: int
    other: int | None
    thing: tuple[Any, Any] | None
    arms: Array


def _coal() -> Any:
    try:
        import coal
    except ImportError:
        raise MeansError(
            "whether a path is free is computed by coal, which is not installed; "
            "pip install 'panda-adapter[motion]'"
        ) from None
    return coal


class ArmInCell:
    """An arm's bodies and what they must not touch.

    Links are capsules, or the convex hulls of their meshes; a mesh in the cell keeps its hollows
    (a tree of bounding volumes over its triangles).

    Args:
        model: of the arm, its base fixed.
        cell: around it.

    Attributes:
        bodies: on the links.
        meanwhile: called every few milliseconds of a search, so that an arm's samples can be read.
        ignored: pairs that are near in nearly every pose, so that they count as joined.

    Raises:
        SettingsError: `cell.allowed` has a name that does not exist, with the choices; a mesh of
            the cell cannot be read.
        MeansError: coal is not installed.
    """

    def __init__(self, model: SelfModel, cell: Cell) -> None:
        self._coal = _coal()
        self.model, self.cell = model, cell
        self.meanwhile: Callable[[], None] = lambda: None
        self.bodies = bodies_of(model, cell.hand)
        self._frames = frames_of(model.tree, model.lam)
        n = model.tree.n
        self._R, self._o = np.zeros((n, 3, 3)), np.zeros((n, 3))
        self._shapes = [self._shape(body) for body in self.bodies]
        self._request = self._coal.DistanceRequest()
        self._pairs = [*self._own_pairs(), *self._cell_pairs()]
        names = {name for pair in self._pairs for name in pair.names}
        for name in (name for pair in cell.allowed for name in pair):
            if name not in names:
                raise SettingsError(f"cell.allowed: no '{name}'; have: {', '.join(sorted(names))}")
        # Pairs of links that are near in nearly every pose, whatever the joints do
        rng, limits = np.random.default_rng(0), self.model.limits
        low = np.where(np.isfinite(limits.lower), limits.lower, -np.pi)
        high = np.where(np.isfinite(limits.upper), limits.upper, np.pi)
        own = [pair for pair in self._pairs if pair.other is not None]
        near = np.zeros(len(own))
        for _ in range(POSES):
            place_frames(self._frames, rng.uniform(low, high), self._R, self._o)
            near += [self._distance(pair) < self.cell.margin for pair in own]
        self.ignored = [
            p.names for p, count in zip(own, near, strict=True) if count > ALWAYS * POSES
        ]
        allowed = {frozenset(pair) for pair in (*cell.allowed, *self.ignored)}
        self._pairs = [pair for pair in self._pairs if frozenset(pair.names) not in allowed]

    def clearance(
        self, motion: PathMotion, path_s: float, at_least: float | None = None
    ) -> Clearance:
        """The least distance from path time 0 to `path_s`, to 5 mm.

        Args:
            motion: drawn; path_s: up to where it is looked at.
            at_least: ask only whether all distances are as large, m: quicker, and the first one
                found that is not comes back.
        """
        speed = motion.bounds()[2]
        least = Clearance(np.inf, ("nothing", "nothing"), 0.0)
        looks = 0
        for pair in tuple(self._pairs):
            nearing, s = float(pair.arms @ speed), 0.0
            while nearing > 0.0 and s <= path_s:
                place_frames(self._frames, motion.path(s)[0], self._R, self._o)
                distance = self._distance(pair)
                looks += 1
                if looks % 100 == 0:  # a few milliseconds
                    self.meanwhile()
                if distance < least.distance:
                    least = Clearance(distance, pair.names, s)
                    if at_least is not None and distance < at_least:
                        self._pairs.remove(pair)
                        self._pairs.insert(0, pair)  # the next motion is likely to touch there, too
                        return least
                goal = least.distance if at_least is None else at_least
                s += max(distance - goal, 0.005) / nearing  # m
        return least

    def at(self, q: Array) -> Clearance:
        """The least distance of one pose (n,)."""
        place_frames(self._frames, q, self._R, self._o)
        found = [Clearance(self._distance(pair), pair.names, 0.0) for pair in self._pairs]
        nothing = Clearance(np.inf, ("nothing", "nothing"), 0.0)
        return min(found, key=lambda each: each.distance, default=nothing)

    def too_near(self, q: Array, at_least: float) -> tuple[float, Array]:
        """Squared shortfalls of all distances, m², summed over poses (m, n), and their gradient
        (m, n), m²/rad."""
        total, slope = 0.0, np.zeros_like(q)
        for pose, own in zip(q, slope, strict=True):
            place_frames(self._frames, pose, self._R, self._o)
            near = [(p, d) for p in self._pairs if (d := self._distance(p)) < at_least]
            if not near:
                continue
            total += sum((at_least - distance) ** 2 for _, distance in near)
            for j in range(len(pose)):
                moved = pose.copy()
                moved[j] += DIFFERENCE_RAD
                place_frames(self._frames, moved, self._R, self._o)
                rise = [(self._distance(p) - d) * (at_least - d) for p, d in near if p.arms[j]]
                own[j] = -2.0 * sum(rise) / DIFFERENCE_RAD
        return total, slope

    def placed(self, q: Array) -> list[tuple[Array, float]]:
        """Corners (k, 3) in base axes and radius of every body in one pose (n,); 2 of a capsule."""
        place_frames(self._frames, q, self._R, self._o)
        return [
            (c.ends if c.link == BASE else self._o[c.link] + c.ends @ self._R[c.link].T, c.radius)
            for c in self.bodies
        ]

    def skeleton(self, q: Array) -> list[Array]:
        """Lines (2, 3) in base axes from the origin of the link before to each link's."""
        place_frames(self._frames, q, self._R, self._o)
        before = [np.zeros(3) if k == BASE else self._o[k] for k in self.model.tree.parent]
        return [np.array(ends) for ends in zip(before, self._o.copy(), strict=True)]

    def _shape(self, body: Body) -> tuple[Any, Array, Array]:
        """Shape, and its turn and place in the link's frame."""
        if body.triangles is not None:
            points, triangles = self._listed(Mesh(body.ends, body.triangles))
            return self._coal.Convex(points, triangles), np.eye(3), np.zeros(3)
        line = body.ends[1] - body.ends[0]
        length = float(np.linalg.norm(line))
        turn = z_to_axis(line / length) if length > 0.0 else np.eye(3)
        return self._coal.Capsule(body.radius, length), turn, body.ends.mean(axis=0)

    def _listed(self, mesh: Mesh) -> tuple[Any, Any]:
        """Corners and triangles as coal takes them."""
        points, triangles = self._coal.StdVec_Vec3s(), self._coal.StdVec_Triangle()
        points.extend(list(mesh.corners))
        triangles.extend([self._coal.Triangle(*row) for row in mesh.triangles.tolist()])
        return points, triangles

    def _placed(self, k: int) -> Any:
        _, turn, place = self._shapes[k]
        link = self.bodies[k].link
        if link == BASE:
            return self._coal.Transform3s(turn, place)
        R = self._R[link]
        return self._coal.Transform3s(R @ turn, self._o[link] + R @ place)

    def _distance(self, pair: Pair) -> float:
        if pair.other is None and pair.thing is None:
            body = self.bodies[pair.one]
            ends = self._o[body.link] + body.ends @ self._R[body.link].T
            furthest = np.linalg.norm(ends, axis=1).max() + body.radius
            return float((self.cell.reach or np.inf) - furthest)
        if pair.other is None:
            assert pair.thing is not None
            shape, place = pair.thing
        else:
            shape, place = self._shapes[pair.other][0], self._placed(pair.other)
        own, result = self._shapes[pair.one][0], self._coal.DistanceResult()
        return float(
            self._coal.distance(own, self._placed(pair.one), shape, place, self._request, result)
        )

    def _own_pairs(self) -> list[Pair]:
        """Every two bodies whose links are not joined to each other."""
        parent, found = self.model.tree.parent, []
        for k, one in enumerate(self.bodies):
            for m, other in enumerate(self.bodies[:k]):
                joined = one.link == other.link or other.link in (
                    parent[one.link] if one.link != BASE else None,
                )
                joined |= other.link != BASE and parent[other.link] == one.link
                if not joined:
                    arms = np.where(
                        self._turned_by(one.link) != self._turned_by(other.link),
                        np.maximum(self._lever(one), self._lever(other)),
                        0.0,
                    )
                    names = self._name(one), self._name(other)
                    found.append(Pair(names, k, m, None, arms))
        return found

    def _cell_pairs(self) -> list[Pair]:
        """Every body that moves against every thing. What the base carries first stands on the
        table, by its mounting."""
        found, things = [], self._things()
        for k, body in enumerate(self.bodies):
            if body.link == BASE:
                continue
            name, arms = self._name(body), self._lever(body)
            first = self.model.tree.parent[body.link] == BASE
            for thing, shape, place in things:
                if not (first and thing == TABLE):
                    found.append(Pair((name, thing), k, None, (shape, place), arms))
            if self.cell.reach is not None:
                found.append(Pair((name, REACH), k, None, None, arms))
        return found

    def _things(self) -> list[tuple[str, Any, Any]]:
        """Name, shape and place of what stands in the cell."""
        coal, cell, things = self._coal, self.cell, []
        if cell.table:
            plane = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
            things.append((TABLE, plane, coal.Transform3s()))
        for box in cell.box:
            place = coal.Transform3s(matrix_from_rpy(box.rpy), np.array(box.xyz))
            things.append((box.name, coal.Box(*box.size), place))
        for pillar in cell.cylinder:
            place = coal.Transform3s(matrix_from_rpy(pillar.rpy), np.array(pillar.xyz))
            things.append((pillar.name, coal.Cylinder(pillar.radius, pillar.length), place))
        for mesh in cell.mesh:
            try:
                surface = read_mesh(mesh.file, (mesh.scale,))
            except ValueError as error:
                raise SettingsError(f"cell.mesh: {error}") from None
            tree = coal.BVHModelOBBRSS()  # of bounding volumes over its triangles
            tree.beginModel(len(surface.triangles), len(surface.corners))
            tree.addSubModel(*self._listed(surface))
            tree.endModel()
            place = coal.Transform3s(matrix_from_rpy(mesh.rpy), np.array(mesh.xyz))
            things.append((mesh.name, tree, place))
        for wall in cell.plane:
            length = float(np.linalg.norm(wall.normal))
            normal = np.array(wall.normal) / length
            things.append((wall.name, coal.Halfspace(normal, wall.offset), coal.Transform3s()))
        return things

    def _name(self, body: Body) -> str:
        tree = self.model.tree
        return tree.base_name if body.link == BASE else tree.link_names[body.link]

    def _turned_by(self, link: int) -> Array:
        """Whether each joint (n,) turns a link."""
        turns = np.zeros(self.model.tree.n, dtype=bool)
        while link != BASE:
            turns[link] = True
            link = self.model.tree.parent[link]
        return turns

    def _lever(self, body: Body) -> Array:
        """How far from each joint's axis (n,) a capsule's line or a hull may be, 0 if not turned.

        From its own joint's, exactly; from those before it at most the lengths between.
        """
        levers, link = np.zeros(self.model.tree.n), body.link
        if link == BASE:
            return levers
        levers[link] = np.linalg.norm(body.ends[:, :2], axis=1).max()
        far = np.linalg.norm(body.ends, axis=1).max()
        while self.model.tree.parent[link] != BASE:
            far += np.linalg.norm(self.model.lam[link, 3:])
            link = self.model.tree.parent[link]
            levers[link] = far
        return levers


class FreeMotion:
    """Draws a motion whose path is free: other phases, then smaller ones, until one is.

    Args:
        arm: in its cell.
        duration_s: until the safe stop begins.
        draw: makes a motion of an attempt and a size.

    Attributes:
        least: the least distance of the motion drawn last; None before.
    """

    def __init__(self, arm: ArmInCell, duration_s: float, draw: Draw = RandomMotion) -> None:
        self.arm, self._duration_s, self._draw = arm, duration_s, draw
        self.least: Clearance | None = None
        self._checked: tuple[Array, ExcitationSettings, int] | None = None

    def __call__(self, limits: MotionLimits, q0: Array, settings: ExcitationSettings) -> PathMotion:
        """A motion from q0 (n,), the same for the same seed.

        Raises:
            SettingsError: the arm does not stand free, or no motion is; names the nearest pair.
        """
        if self._checked is not None:
            before, same, k = self._checked
            if settings == same and np.abs(q0 - before).max() < SAME_START:
                return self._draw(limits, q0, settings, k, SHRINK ** (k // SAME_SIZE))
        margin, nearest = self.arm.cell.margin, self.arm.at(q0)
        if nearest.distance < margin:
            raise SettingsError(
                f"the arm stands too near to start: {nearest}, where {margin:g} m are kept; move "
                "it by hand, or describe the cell in --config ([cell]); where their shapes only "
                f'seem to touch, say allowed = [["{nearest.names[0]}", "{nearest.names[1]}"]] there'
            )
        path_s = self._duration_s + settings.stop_s + 5.0  # s of path behind the stop
        for k in range(ATTEMPTS):
            motion = self._draw(limits, q0, settings, k, SHRINK ** (k // SAME_SIZE))
            nearest = self.arm.clearance(motion, path_s, margin)
            if nearest.distance >= margin:
                self.least = self.arm.clearance(motion, path_s)
                self._checked = q0, settings, k
                return motion
        raise SettingsError(
            f"no free motion was found from here; the nearest of the last one: {nearest}, where "
            f"{margin:g} m are kept. Move the arm to where it has more room, or take another motion"
        )
