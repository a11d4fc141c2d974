"""A self model as a robot's file has it, with the joint axes that its source had.

What effects add to the arm comes in a record that knows nothing of them; `effects.robots` fills it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from adapter.errors import ModelError
from adapter.model.inertia import (
    CONSISTENCY_TOLERANCE,
    is_consistent,
    min_eigenvalue,
    six_from_tensor,
)
from adapter.model.robot_file import SLIDING, FileJoint, FileRobot
from adapter.model.self_model import LIMITS, URDF, SelfModel, Source, base_inertia, turned_theta
from adapter.model.spatial import Array, at_joints, z_to_axis
from adapter.model.tree import BASE

# What a joint of a file may have beside its limits; a format has some of them.
# Breakaway is by how much more than friction it takes to begin to slide.
DAMPING, FRICTION, BREAKAWAY = "damping", "friction", "breakaway"
ARMATURE, STIFFNESS = "armature", "stiffness"
DRAG, CUBIC_DRAG = "drag", "cubic drag"  # torque per dq |dq| and per dq³
NO_PLACE = ""
SIX = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")  # of a tensor, as URDF names them
NO_INERTIA = """<inertial>
  <mass value="0"/>
  <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>
</inertial>"""


class Kept(NamedTuple):
    """How much of an effect a file holds.

    Attributes:
        effect: its name; of: the joint it has, and its numbers, in words.
        part: None for all of it, else what is there in words, `NO_PLACE` for nothing.
    """

    effect: str
    of: str
    part: str | None


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
        kept: how much of which effect is in the file; left_out: what else has no place, in words.
    """

    n: int
    floating: bool
    places: tuple[str, ...]
    kept: list[Kept] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
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


def as_file(model: SelfModel, more: Additions) -> FileRobot:
    """The arm as a robot's file has it, parents first; what `robot_file.Merged` reads undone.

    Each link's frame is turned back to its original axis: R_file = Q_i R_ij Q_jᵀ, p_file = Q_i p.
    Frames that ride on links come out as links of no mass on fixed joints, the tool and loads as
    links of their own. How the base stands, and what joints have beside, stay in `more`.

    Raises:
        ModelError: where a body is physically impossible; names the link and the eigenvalue.
    """
    tree, limits = model.tree, np.column_stack([getattr(model.limits, key) for key in LIMITS])
    zero, turns = (model.joint_rotation(), model.lam[:, 3:]), {tree.base_name: np.eye(3)}
    turned, placed = at_joints(*zero, -more.offset, tree.slides)  # q = q_measured - offset
    links, joints = {tree.base_name: base_inertia(model)}, dict[str, FileJoint]()

    def fix(name: str, parent: str, child: str, rotation: Array, position: Array) -> None:
        own = name, "fixed", parent, child, rotation, position
        joints[name] = FileJoint(*own, np.array([1.0, 0.0, 0.0]), np.full(4, math.nan), None)

    for k, (name, joint) in enumerate(zip(tree.link_names, tree.joint_names, strict=True)):
        parent = tree.base_name if tree.parent[k] == BASE else tree.link_names[tree.parent[k]]
        turns[name] = z_to_axis(model.axis[k])
        kind = "revolute" if np.isfinite(limits[k, :2]).all() else "continuous"
        kind = SLIDING[0] if tree.slides[k] else kind
        place = turns[parent] @ turned[k] @ turns[name].T, turns[parent] @ placed[k]
        own = joint, kind, parent, name, *place, model.axis[k], limits[k], None
        joints[joint] = FileJoint(*own)
        links[name] = turned_theta(model.theta[k - tree.n] + more.dtheta[k], turns[name])
    for frame in model.frames:
        links[frame.name], turn = np.zeros(10), turns[frame.parent]
        place = turn @ frame.rotation, turn @ frame.position
        fix(frame.joint, frame.parent, frame.name, *place)
    last, carried = tree.link_names[-1], list[tuple[str, str, Array]]()
    if model.tool is not None:
        carried.append((model.tool_link, f"{model.tool_link}_tool", model.tool.theta()))
    for number, load in enumerate(more.loads):
        carried.append((last, f"{last}_payload{f'_{number + 1}' if number else ''}", load))
    for link, name, theta in carried:
        links[name] = turned_theta(theta, turns[link])
        fix(f"{name}_joint", link, name, np.eye(3), np.zeros(3))
    for name, theta in links.items():
        if np.any(theta) or name in tree.body_names:
            check_possible(theta, name)
    return FileRobot("", model.name, links, joints, Source(URDF, ""))


def number_text(values: ArrayLike, between: str = " ") -> str:
    """Numbers that read back unchanged; a negative zero loses its sign."""
    numbers = np.atleast_1d(np.asarray(values, dtype=np.float64))
    return between.join(repr(float(value) + 0.0) for value in numbers)


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
