"""A robot as a file describes it, and the self model in it: fixed links merged, the rest locked.

The rule of the axes: the frame of a link that turns about axis u of its file's frame, or slides
along it, is that frame, turned by the smallest rotation Q that takes z to u (`spatial.z_to_axis`;
by π about x for u = -z). Then Rot(u, q) = Q Rz(q) Qᵀ, and the joint turns about its own z as eq. 9
of the paper wants it: R_ij = Q_iᵀ R_file Q_j Rz(q), p = Q_iᵀ p_file. `urdf_text` undoes it.

A gripper's fingers are locked unless somebody asks for them; a joint that the recording lacks is
locked where the two meet (`signals.matching`).

Links are judged at reading: what no body has, or no motion shows. Of 106 robots' files
(`example-robot-data`, PyBullet; 1648 links) none is told grams, and six have inertias that no body
has. Of the same links with masses in grams 99 % are told, 85 % where inertias are in g m² too.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter.errors import ModelError, ModelWarning
from adapter.model.inertia import body_from_theta, move_theta
from adapter.model.locking import FOLLOWS, LOCKED
from adapter.model.self_model import (
    STANDARD_GRAVITY,
    FixedFrame,
    Limits,
    SelfModel,
    Source,
    turned_theta,
)
from adapter.model.spatial import Array, exp_rotation, z_to_axis, zxz_from_matrix
from adapter.model.tree import BASE, Tree
from drivers.errors import choices

DENSEST = 22_590.0  # kg/m³, osmium
PLACEHOLDER_KG = 10.0  # lighter links have inertias that nobody measured (a camera's, 1e-6 kg m²)
POINT_M2 = 1e-8  # inertia per mass, of what a file means as a point
LIGHT = 1e-3  # of the heaviest link: what changes nothing is not judged
ROUNDED = 0.05  # of a trace, by which digits left out may make an inertia impossible (2 % seen)
NEGATIVE, NO_SIZE = 1e-3, 1e-12  # of the largest moment, and kg m²: rounding makes less
ALIKE, MANY = 1e-6, 3  # of the largest moment; links of an arm
# What no sensor feels: N m (N) to hold a link and turn it at 10 rad/s², with so many kg behind
UNFELT_NM, TURNED, UNFELT_KG = 1e-4, 10.0, 1e-3


def check_links(file: str, links: Mapping[str, Array]) -> None:
    """Warn of links, θ (10,) each by name, with a mass in grams or an inertia that no body has."""
    heaviest = max(float(theta[0]) for theta in links.values())
    grams, impossible = [], []
    for name, theta in links.items():
        mass, _, tensor = body_from_theta(theta)
        least, middle, most = np.linalg.eigvalsh(tensor)
        spread = (least + middle + most) / 2.0
        if mass < LIGHT * heaviest or spread <= POINT_M2 * mass:
            continue
        if in_grams(theta):
            grams.append(f"'{name}' of {mass:.4g} kg")
        elif most - middle - least > 2.0 * ROUNDED * spread:
            told = ", ".join(f"{x:.3g}" for x in (least, middle, most))
            impossible.append(f"'{name}' ({told} kg m²)")
    _warn(file, "denser than any metal with the inertia it has is link", grams,
          "is its mass in grams? Give kg and kg m²")  # fmt: skip
    _warn(file, "no body has the principal moments of inertia of link", impossible,
          "none may be larger than the other two together, or below zero")  # fmt: skip


def in_grams(theta: Array) -> bool:
    """Whether a body (10,) is denser than any metal, its mass being as near to its centre."""
    mass, _, tensor = body_from_theta(theta)
    spread = max(np.trace(tensor) / 2.0, 0.0)
    # no body of this density has its mass as near to its centre as a ball of it
    ball = 4.0 / 3.0 * math.pi * (5.0 / 3.0 * spread / mass) ** 1.5 if mass > 0.0 else 0.0
    return bool(mass >= PLACEHOLDER_KG and spread > POINT_M2 * mass and mass > DENSEST * ball)


def made_up(theta: Array) -> list[int]:
    """Of bodies (n, 10) those that turn alike about all axes, where several do: nobody measured."""
    mass = theta[:, 0]
    moments = [
        np.linalg.eigvalsh(body_from_theta(x)[2]) if x[0] > 0.0 else np.zeros(3) for x in theta
    ]
    balls = np.ptp(moments, axis=1) < ALIKE * np.max(moments, axis=1)
    found = np.flatnonzero(balls & (mass > LIGHT * mass.max()))
    return found.tolist() if len(found) >= MANY else []


def check_moving(file: str, bodies: Sequence[tuple[str, str, int, Array, bool]]) -> None:
    """Judge what moves, with all that is fixed to it.

    Args:
        file: what messages call it.
        bodies: link, its joint, number of the body it hangs on, θ (10,), and whether the joint
            slides along z or turns about it, through the origin; parents first. A base that
            floats hangs on no joint ("").

    Raises:
        ModelError: a principal moment of inertia is below zero: no motion can be computed.
    """
    behind, unfelt = np.zeros(len(bodies)), []
    for k in reversed(range(len(bodies))):
        link, joint, over, theta, slides = bodies[k]
        moments = np.linalg.eigvalsh(body_from_theta(theta)[2])
        if moments[0] < -max(NEGATIVE * moments[2], NO_SIZE):
            raise ModelError(
                f"{file}: moving link '{link}' has a principal moment of inertia of "
                f"{moments[0]:.3g} kg m², which is below zero; correct its <inertia>"
            )
        felt = STANDARD_GRAVITY * math.hypot(theta[1], theta[2]) + TURNED * theta[9]
        felt = STANDARD_GRAVITY * theta[0] if slides else felt
        if joint and felt < UNFELT_NM and behind[k] < UNFELT_KG:
            unfelt.append(f"'{joint}' (link '{link}' of {theta[0]:.3g} kg)")
        if over >= 0:
            behind[over] += behind[k] + theta[0]
    balls = made_up(np.array([body[3] for body in bodies]).reshape(-1, 10))
    _warn(file, "somebody made up the inertias, those of a ball, of link",
          [f"'{bodies[k][0]}'" for k in balls],
          "nothing is known of a load or of the links but what logs tell")  # fmt: skip
    _warn(file, "so little hangs on it that no torque shows it: joint", unfelt[::-1],
          "lock it, or give the link its mass and inertia")  # fmt: skip


def _warn(file: str, what: str, found: Sequence[str], do: str) -> None:
    if found:
        named = ", ".join(found if len(found) < 5 else [*found[:3], f"{len(found) - 3} more"])
        warnings.warn(f"{file}: {what} {named}; {do}", ModelWarning, stacklevel=5)


TURNING = ("revolute", "continuous")
SLIDING = ("prismatic",)
MOVING = (*TURNING, *SLIDING)
FINGERS = ("finger", "grip", "jaw", "claw")  # what joints of grippers are called


@dataclass(frozen=True)
class FileJoint:
    """A joint as written: placement in the parent link's frame, axis in its own.

    `limits` are [lower upper velocity effort], NaN where not given; `mimic` is the name of the
    joint that it follows, the factor and the offset.
    """

    name: str
    kind: str
    parent: str
    child: str
    rotation: Array
    position: Array
    axis: Array
    limits: Array
    mimic: tuple[str, float, float] | None


@dataclass(frozen=True)
class FileRobot:
    """A file's content: θ (10,) of each link in its own frame, and the joints, as written.

    `source` is what a model remembers of it, but for λ, which it does not know yet.
    """

    file: str
    name: str
    links: dict[str, Array]
    joints: dict[str, FileJoint]
    source: Source

    def value(self, joint: FileJoint, moving: set[str], lock: Mapping[str, float]) -> float:
        """Where a joint that does not move stands, rad or m: as told, or after its leader.

        A leader that moves, or of which nothing is told, is at zero.
        """
        leader, factor, offset = self.followed(joint, moving | lock.keys())
        return factor * lock.get(leader, 0.0) + offset

    def followed(self, joint: FileJoint, last: Set[str] = frozenset()) -> tuple[str, float, float]:
        """Name of the joint that one follows, be it through others up to one of `last`; its own
        where it follows none. With the factor and the offset of its value to that one's.
        """
        seen, factor, offset = {joint.name}, 1.0, 0.0
        while joint.mimic is not None and joint.name not in last:
            name, times, plus = joint.mimic
            if name in seen or name not in self.joints:
                break
            factor, offset = factor * times, offset + factor * plus
            seen.add(name)
            joint = self.joints[name]
        return joint.name, factor, offset


def _root(robot: FileRobot) -> str:
    """The one link that is nobody's child; every link must hang on it, by one joint."""
    parent_of: dict[str, FileJoint] = {}
    for joint in robot.joints.values():
        if joint.child in parent_of:
            both = f"'{parent_of[joint.child].name}' and '{joint.name}'"
            said = f"is the child of joints {both}; a loop can't be read, remove one of them"
            raise ModelError(f"{robot.file}: link '{joint.child}' {said}")
        parent_of[joint.child] = joint
    roots = [name for name in robot.links if name not in parent_of]
    if len(roots) > 1:
        said = f"({', '.join(roots)}); a robot has one, join them with fixed joints"
        raise ModelError(f"{robot.file}: {len(roots)} root links {said}")
    for name in robot.links:
        seen = [name]
        while seen[-1] in parent_of:
            seen.append(parent_of[seen[-1]].parent)
            if seen[-1] in seen[:-1]:
                said = f"{' -> '.join(reversed(seen))} form a loop; a tree is needed"
                raise ModelError(f"{robot.file}: links {said}")
    return roots[0]


def _moving(robot: FileRobot, wanted: Sequence[str] | None, lock: Mapping[str, float]) -> set[str]:
    """Names of the joints that move in the model; warns about each that is locked unasked."""
    own = [j for j in robot.joints.values() if j.kind in MOVING and j.mimic is None]
    free = [j.name for j in own if wanted is None and not _finger(robot, j)]
    chosen = {name for name in free if name not in lock} if wanted is None else set(wanted)
    _check_joints(robot, chosen, MOVING, "joints that move")
    _check_joints(robot, lock, MOVING, "joints that can be locked")
    if chosen & lock.keys():
        both = min(chosen & lock.keys())
        raise ModelError(f"{robot.file}: joint '{both}' cannot be learned and locked; do one")
    for joint in robot.joints.values():
        if joint.name not in (*chosen, *lock) and joint.kind != "fixed":
            value, leader = robot.value(joint, chosen, lock), robot.followed(joint, chosen)[0]
            follows = f" and mimics {leader}" if joint.mimic else ""
            if leader in chosen:
                why = "no model here follows; what it takes is not in its leader"
                below = _below(robot, joint)
                borne = [x for x, j in robot.joints.items() if x in chosen and j.parent in below]
                if borne:
                    why += f", and {', '.join(borne)} behind it will not be where they are"
                follows += f", which moves ({why})"
            at = "zero" if value == 0.0 else f"{value:.6g}"
            finger = joint in own and wanted is None
            what = ", of a gripper as it seems (--joints A,B,... frees it)" if finger else ""
            said = f"joint '{joint.name}' is {joint.kind}{follows}{what}; locked at {at}"
            warnings.warn(f"{robot.file}: {said}", ModelWarning, stacklevel=6)
    return chosen


def _below(robot: FileRobot, joint: FileJoint) -> set[str]:
    """The links that a joint moves, its own child and all that hang on it."""
    links, found = {joint.child}, 0
    while len(links) > found:
        found = len(links)
        links |= {j.child for j in robot.joints.values() if j.parent in links}
    return links


def _finger(robot: FileRobot, joint: FileJoint) -> bool:
    """Whether a joint slides a finger: it carries none that turns, and has another beside it on its
    link, is followed by one that mimics it, or is named so."""
    if joint.kind not in SLIDING:
        return False
    links, every = _below(robot, joint), robot.joints.values()
    if any(j.kind in TURNING and j.parent in links and j.mimic is None for j in every):
        return False
    followed = any(robot.followed(j)[0] == joint.name for j in every if j is not joint)
    beside = sum(j.kind in SLIDING and j.parent == joint.parent for j in every) > 1
    return followed or beside or any(word in joint.name.lower() for word in FINGERS)


def _check_joints(robot: FileRobot, names: Iterable[str], kinds: Sequence[str], what: str) -> None:
    """Refuse a name without a joint of these kinds."""
    for name in sorted(names):
        joint = robot.joints.get(name)
        if joint is None or joint.kind not in kinds:
            fault = "is not there" if joint is None else f"is {joint.kind}"
            have = [j.name for j in robot.joints.values() if j.kind in kinds]
            told = choices(name, have, f" ({what})")
            raise ModelError(f"{robot.file}: joint '{name}', asked for, {fault}; {told}")


@dataclass
class Body:
    """A moving link (or the base) while the file is walked; frames turned as the rule says."""

    name: str
    parent: int
    joint: FileJoint | None
    rotation: Array
    position: Array
    theta: Array
    merged: list[str] = field(default_factory=list)


class Merged:
    """A robot's links walked depth first, in the file's order, what does not move merged.

    Attributes:
        robot: the file's content; order: bodies that move, parents first.
        place: of each link of the file the body it belongs to (-1 for the base) and its frame
            (R, p) in that of the body.

    Raises:
        ModelError: one sentence naming the file, the element and the choices.
    """

    def __init__(
        self,
        robot: FileRobot,
        joints: Sequence[str] | None = None,
        lock: Mapping[str, float] | None = None,
    ) -> None:
        self.robot, self.lock = robot, lock or {}
        self.moving = _moving(robot, joints, self.lock)
        self.place: dict[str, tuple[int, Array, Array]] = {}
        self.order: list[Body] = []
        self.frames: list[FixedFrame] = []
        self.children: dict[str, list[FileJoint]] = {name: [] for name in robot.links}
        for joint in robot.joints.values():
            self.children[joint.parent].append(joint)
        root = _root(robot)
        self.base = Body(root, BASE, None, np.eye(3), np.zeros(3), robot.links[root])
        eye, zero = np.eye(3), np.zeros(3)
        self.place[root] = BASE, eye, zero
        # Joints still to visit, the number of the body they hang on, and the placement in it of
        # the URDF frame of the link they hang on.
        todo = [(joint, BASE, eye, zero) for joint in reversed(self.children[root])]
        while todo:
            joint, number, rotation, position = todo.pop()
            rotation, position = rotation @ joint.rotation, position + rotation @ joint.position
            number, rotation, position = self._visit(joint, number, rotation, position)
            self.place[joint.child] = number, rotation, position
            below = reversed(self.children[joint.child])
            todo += [(child, number, rotation, position) for child in below]
        if not self.order:
            have = ", ".join(f"{j.name} ({j.kind})" for j in robot.joints.values()) or "no joints"
            raise ModelError(f"{robot.file}: no joint is left to move; have: {have}")

    def _visit(self, joint: FileJoint, number: int, r: Array, p: Array) -> tuple[int, Array, Array]:
        """Take in the child of a joint at (r, p) in body `number`: its body and placement there."""
        theta = self.robot.links[joint.child]
        if joint.name in self.moving:
            turn = z_to_axis(joint.axis)
            turned = turned_theta(theta, turn.T)
            self.order.append(Body(joint.child, number, joint, r @ turn, p, turned))
            return len(self.order) - 1, turn.T, np.zeros(3)
        value = self.robot.value(joint, self.moving, self.lock)
        if joint.kind in TURNING:
            r = r @ exp_rotation(joint.axis * value)
        else:
            p = p + r @ joint.axis * value
        body = self.body(number)
        body.theta = body.theta + move_theta(theta, r, p)
        body.merged.append(joint.child)
        self.frames.append(FixedFrame(joint.child, joint.name, body.name, r, p))
        return number, r, p

    def body(self, number: int) -> Body:
        """The body of that number, -1 for the base."""
        return self.base if number == BASE else self.order[number]

    def _check_bodies(self, floating: bool) -> None:
        """Judge the links; refuse a moving one without mass: no motion of it could be explained."""
        file, moving = self.robot.file, [self.base, *self.order] if floating else self.order
        for body in moving:
            if body.theta[0] <= 0.0:
                rest = f" (with {', '.join(body.merged)})" if body.merged else ""
                joint = f"leave joint '{body.joint.name}' out" if body.joint else "fix the base"
                said = f"has no mass; give it an <inertial> or {joint}"
                raise ModelError(f"{file}: moving link '{body.name}'{rest} {said}")
        told = [(b, *((b.joint.name, b.joint.kind) if b.joint else ("", ""))) for b in moving]
        bodies = [(b.name, j, b.parent + floating, b.theta, k in SLIDING) for b, j, k in told]
        check_moving(file, bodies)
        check_links(file, self.robot.links)

    def _followers(self) -> dict[str, tuple[str, float, float, str]]:
        """Entry `FOLLOWS` of the model's provenance."""
        found = {}
        for joint in self.robot.joints.values():
            leader, factor, offset = self.robot.followed(joint, self.moving)
            if leader != joint.name and joint.name not in self.moving | self.lock.keys():
                found[joint.name] = leader, factor, offset, "m" if joint.kind in SLIDING else "rad"
        return found

    def model(self, floating: bool, gravity: Array) -> SelfModel:
        """The self model of what was walked.

        Args:
            floating: whether the base is free.
            gravity: (3,) in base axes, m/s².

        Raises:
            ModelError: a moving body without mass, or with a negative moment of inertia.
        """
        self._check_bodies(floating)
        base, order = self.body(BASE), self.order
        joints = [body.joint for body in order if body.joint is not None]
        tree = Tree(
            tuple(body.parent for body in order),
            floating,
            tuple(joint.name for joint in joints),
            tuple(body.name for body in order),
            base.name,
            tuple(joint.kind in SLIDING for joint in joints),
        )
        theta = np.stack([body.theta for body in order])
        told: dict[str, Any] = {LOCKED: dict(self.lock)} if self.lock else {}
        if followers := self._followers():
            told[FOLLOWS] = followers
        lam = np.stack([np.r_[zxz_from_matrix(b.rotation), b.position] for b in order])
        return SelfModel(
            name=self.robot.name,
            tree=tree,
            lam=lam,
            theta=np.vstack([base.theta, theta]) if floating else theta,
            base_theta=np.zeros(10) if floating else base.theta,
            limits=Limits(*np.stack([joint.limits for joint in joints], axis=1)),
            axis=np.stack([joint.axis for joint in joints]),
            frames=tuple(self.frames),
            gravity=gravity,
            source=replace(self.robot.source, lam=lam),
            provenance={self.robot.source.format: Path(self.robot.file).name, **told},
        )
