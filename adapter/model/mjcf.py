"""MJCF (MuJoCo's XML) into a self model, and a learned model back onto it; MuJoCo reads it.

A link of the model stands where its joint turns: at the joint's place in the body, with the
body's axes.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from adapter import optional
from adapter.errors import ModelError, ModelWarning
from adapter.model import spatial
from adapter.model.filled import MJCF_PLACES, as_written, joint_attributes, principal
from adapter.model.inertia import body_from_theta, move_theta, theta_from_body
from adapter.model.onto import Changes, changes_onto
from adapter.model.robot_file import FileJoint, FileRobot, Merged
from adapter.model.self_model import MJCF, SelfModel, Source
from adapter.model.urdf import file_text
from adapter.model.urdf_text import CUBIC_DRAG, DRAG, STIFFNESS, Additions, number_text
from adapter.model.xml_edit import Element, XmlText

KINDS = ("floating", "ball", "prismatic", "revolute")  # of joints, by MuJoCo's numbers
FREE, SLIDE, HINGE = 0, 2, 3
EQUAL_JOINTS = 2  # MuJoCo's number of an equality of two joints' angles
OTHER_TURNS = ("axisangle", "euler", "xyaxes", "zaxis")  # ways to turn a body beside quat
READ_BACK = 1e-7  # of a number's scale: what MuJoCo's own arithmetic may change


def read_mjcf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
    lock: Mapping[str, float] | None = None,
) -> tuple[SelfModel, list[dict[str, float]]]:
    """The self model of an MJCF file, and what its joints have beside the rigid arm.

    Args:
        path, joints, lock: as of `urdf.read_urdf`.
        floating: whether the base is free: the free body that carries most joints.
        gravity: (3,) in base axes, m/s²; the file's where None.

    Returns:
        The model, and by joint what MuJoCo calls armature, damping, frictionloss, stiffness and
        springref, and its damping's polynomial by `filled.MJCF_PLACES`, where not zero.

    Raises:
        ModelError: one sentence naming the file, the element and the choices.
    """
    compiled = compiled_mjcf(path)
    file = MjcfFile(compiled, Path(path), floating)
    for part in file.unused:
        warnings.warn(f"{path}: {part} is not used", ModelWarning, stacklevel=3)
    merged = Merged(file.robot(), joints, lock)
    turn = spatial.matrix_from_quaternion(compiled.body_quat[file.root])
    down = turn.T @ compiled.opt.gravity if gravity is None else spatial.vector3(gravity)
    model = merged.model(floating, down)
    return model, [file.extras(name) for name in model.tree.joint_names]


def mjcf_onto(model: SelfModel, more: Additions, path: str | Path) -> tuple[str, list[str]]:
    """The MJCF with what was learned in it, and notes on it in words.

    Inertials, places of bodies and what joints have beside the rigid arm change, and these only
    where their numbers do.

    Args:
        model: the arm; more: what it has beside, `places` being `MJCF_PLACES`.
        path: of the MJCF.

    Raises:
        ModelError: as `onto.changes_onto`; a body that stands in another file or has no name; a
            file whose <compiler> overrides what is written.
    """
    file = MjcfFile(compiled_mjcf(path), Path(path), model.tree.floating)
    changes = changes_onto(model, more, file.robot())
    writer = _Writer(file, XmlText(file_text(path), str(path)))
    writer.write(model, more, changes)
    text = writer.xml.text()
    back = MjcfFile(compiled_mjcf(path, text), Path(path), model.tree.floating)
    left = changes_onto(replace(model, source=None), more, back.robot(), READ_BACK)
    if left.origins or left.bodies:
        names = ", ".join([*left.origins, *left.bodies])
        raise ModelError(
            f"{path}: MuJoCo reads other numbers than were written for {names}; look for "
            "inertiafromgeom, balanceinertia, boundmass or settotalmass in <compiler>"
        )
    return text, changes.notes


def compiled_mjcf(path: str | Path, text: str | None = None) -> Any:
    """MuJoCo's model of a file, or of a text in its place."""
    top = XmlText(file_text(path), str(path)).root.tag
    if top != "mujoco":
        is_urdf = "; a URDF's name ends in .urdf" if top == "robot" else ""
        raise ModelError(f"{path}: top element is <{top}>, an MJCF has <mujoco>{is_urdf}")
    mujoco = optional.load("mujoco")
    try:
        if text is None:
            return mujoco.MjModel.from_xml_path(str(path))
        folder = Path(path).parent
        spec = mujoco.MjSpec.from_string(text, include=_included(text, folder))
        spec.modelfiledir = str(folder)
        return spec.compile()
    except ValueError as error:
        said = " ".join(str(error).split())
        raise ModelError(f"{path}: MuJoCo cannot read it ({said})") from None


def _included(text: str, folder: Path) -> dict[str, bytes]:
    """Texts of the files that an MJCF takes in, by name."""
    found: dict[str, bytes] = {}
    for element in XmlText(text, str(folder)).root.walk():
        if element.tag == "include":
            name = element.attributes["file"]
            found[name] = (folder / name).read_bytes()
            found |= _included(found[name].decode("utf-8"), folder)
    return found


class MjcfFile:
    """What of a compiled MJCF can be an arm.

    Attributes:
        compiled: MuJoCo's model; path: of its file.
        anchor: (bodies, 3) where each body's joint is in it: the origin of its link.
        unused: which parts the arm is without, in words.

    Raises:
        ModelError: no body that fits, two joints in one body.
    """

    def __init__(self, compiled: Any, path: Path, floating: bool) -> None:
        self.compiled, self.path = compiled, path
        self.anchor = np.zeros((compiled.nbody, 3))
        self.unused: list[str] = []
        for i in range(compiled.nbody):
            joints = self._joints_in(i)
            hinges = [j for j in joints if compiled.jnt_type[j] == HINGE]
            if len(joints) > 1:
                raise ModelError(
                    f"{path}: body '{self._name(i)}' has {len(joints)} joints; an arm's body has "
                    "one, put the others into bodies of their own"
                )
            if hinges:
                self.anchor[i] = compiled.jnt_pos[hinges[0]]
        self._numbers = {self._joint_name(j): j for j in range(compiled.njnt)}
        self._parents = compiled.body_parentid.tolist()
        self.root, self._bodies = self._choose(floating)
        m = compiled
        self.unused += [f"tendon '{m.tendon(k).name or k}'" for k in range(m.ntendon)]
        for k in range(m.neq):
            if m.eq_type[k] != EQUAL_JOINTS:
                self.unused.append(f"equality '{m.equality(k).name or k}'")
        for i, mocap in enumerate(m.body_mocapid):
            self.unused += [f"mocap body '{self._name(i)}'"] if mocap >= 0 else []
        for what, count in (
            ("sensors", m.nsensor),
            ("actuators, but for the torque that they can give,", m.nu),
            ("flexible bodies", m.nflex),
            ("keyframes", m.nkey),
        ):
            self.unused += [f"what it says of {what} ({count})"] if count else []

    def robot(self) -> FileRobot:
        """Links and joints as a file's content."""
        links = {self._name(self.root): self._theta(self.root)}
        joints = {}
        for i in self._bodies:
            joint = self._joint(i)
            links[joint.child] = self._theta(i)
            joints[joint.name] = joint
        name = self.compiled.names.split(b"\0")[0].decode() or self.path.stem
        source = Source(MJCF, str(self.path.resolve()))
        return FileRobot(str(self.path), name, links, joints, source)

    def extras(self, name: str) -> dict[str, float]:
        """What a joint has beside the rigid arm, by MuJoCo's names; zeros left out."""
        joint = self.compiled.joint(self._numbers[name])
        polynomial = np.ravel(getattr(joint, "dampingpoly", (0.0, 0.0)))  # before MuJoCo 4 none
        out = dict(zip((DRAG, CUBIC_DRAG), map(float, polynomial), strict=True))
        plain = [key for key in MJCF_PLACES.values() if key not in out]
        out |= {key: float(np.ravel(getattr(joint, key))[0]) for key in plain}
        if out[MJCF_PLACES[STIFFNESS]]:
            out["springref"] = float(self.compiled.qpos_spring[joint.qposadr[0]])
        return {key: value for key, value in out.items() if value}

    def zero(self, body: int) -> float:
        """Angle or way (rad, m) of a body's joint where the body stands as written."""
        joints = self._joints_in(body)
        if not joints or self.compiled.jnt_type[joints[0]] < 2:
            return 0.0
        return float(self.compiled.qpos0[self.compiled.jnt_qposadr[joints[0]]])

    def _joints_in(self, body: int) -> range:
        first, count = self.compiled.body_jntadr[body], self.compiled.body_jntnum[body]
        return range(first, first + count)

    def _name(self, body: int) -> str:
        return self.compiled.body(body).name or f"body{body}"

    def _joint_name(self, joint: int) -> str:
        return self.compiled.joint(joint).name or f"joint{joint}"

    def _choose(self, floating: bool) -> tuple[int, list[int]]:
        """The base's body and those that hang on it."""
        m = self.compiled
        free = [i for i in range(m.nbody) if any(m.jnt_type[j] == FREE for j in self._joints_in(i))]
        over: list[set[int]] = []  # each with all that carry it, which come before it
        for i, parent in enumerate(self._parents):
            over.append({i} | (over[parent] if i else set()))

        counted = HINGE if (m.jnt_type == HINGE).any() else SLIDE

        def hinges(root: int) -> int:
            below = (j for i in range(m.nbody) if root in over[i] for j in self._joints_in(i))
            return sum(m.jnt_type[j] == counted for j in below)

        if floating:
            if not free:
                raise ModelError(f"{self.path}: no body has a free joint; the base is fixed")
            root = max(free, key=hinges)
        else:
            fixed = [i for i in range(1, m.nbody) if not any(x in free for x in over[i])]
            tops = [i for i in fixed if self._parents[i] == 0 and hinges(i)]
            alone = len(tops) == 1 and not self._joints_in(tops[0])
            root = tops[0] if alone else 0
        dropped = [i for i in free if i != root]
        self.unused += [f"free body '{self._name(i)}'" for i in dropped]
        below = [i for i in range(m.nbody) if root in over[i] and i != root]
        return root, [i for i in below if not any(x in dropped for x in over[i])]

    def _theta(self, body: int) -> spatial.Array:
        """θ (10,) of a body in the frame of its link."""
        m = self.compiled
        if body == 0:
            return np.zeros(10)
        own = theta_from_body(m.body_mass[body], np.zeros(3), np.diag(m.body_inertia[body]))
        turn = spatial.matrix_from_quaternion(m.body_iquat[body])
        return move_theta(own, turn, m.body_ipos[body] - self.anchor[body])

    def _joint(self, body: int) -> FileJoint:
        """How a body hangs on the one that carries it, at joint angle zero."""
        m, parent = self.compiled, self._parents[body]
        turn = spatial.matrix_from_quaternion(m.body_quat[body])
        place = m.body_pos[body] + turn @ self.anchor[body] - self.anchor[parent]
        name, kind, axis = f"{self._name(body)}_fixed", "fixed", np.array([0.0, 0.0, 1.0])
        limits, mimic = np.full(4, np.nan), None
        for j in self._joints_in(body):
            name, kind = self._joint_name(j), KINDS[m.jnt_type[j]]
            axis = m.jnt_axis[j].copy()
            if kind == "prismatic":
                place = place - turn @ axis * self.zero(body)
            if kind == "revolute":
                turn = turn @ spatial.exp_rotation(-self.zero(body) * axis)
            if m.jnt_type[j] in (SLIDE, HINGE):
                limits, mimic = self._limits(j), self._followed(j)
        parent_name, own = self._name(parent), self._name(body)
        return FileJoint(name, kind, parent_name, own, turn, place, axis, limits, mimic)

    def _limits(self, joint: int) -> spatial.Array:
        """[lower upper velocity effort] of a joint, NaN where not given."""
        m, out = self.compiled, np.full(4, np.nan)
        if m.jnt_limited[joint]:
            out[:2] = m.jnt_range[joint]
        if m.jnt_actfrclimited[joint]:
            out[3] = np.abs(m.jnt_actfrcrange[joint]).max()
            return out
        for k in range(m.nu):
            drives = m.actuator_trntype[k] == 0 and m.actuator_trnid[k, 0] == joint
            if drives and m.actuator_forcelimited[k]:
                out[3] = np.abs(m.actuator_forcerange[k] * m.actuator_gear[k, 0]).max()
        return out

    def _followed(self, joint: int) -> tuple[str, float, float] | None:
        """The joint that an equality makes a joint follow, the factor and the offset."""
        m = self.compiled
        for k in range(m.neq):
            leader = m.eq_obj2id[k]
            if m.eq_type[k] == EQUAL_JOINTS and m.eq_obj1id[k] == joint and leader >= 0:
                zero, zero_leader = (m.qpos0[m.jnt_qposadr[j]] for j in (joint, leader))
                constant, factor = m.eq_data[k, :2]
                offset = zero + constant - factor * zero_leader
                return self._joint_name(leader), float(factor), float(offset)
        return None


@dataclass
class _Writer:
    """Writes numbers into an MJCF's text."""

    file: MjcfFile
    xml: XmlText

    def write(self, model: SelfModel, more: Additions, changes: Changes) -> None:
        """All that changes."""
        joints = self.file.robot().joints
        for name, (rotation, position) in changes.origins.items():
            self._place(joints[name], rotation, position)
        for name, theta in changes.bodies.items():
            self._body(name, theta)
        for k, name in enumerate(model.tree.joint_names):
            now = self.file.extras(name)
            before, after = as_written(now), as_written(now | joint_attributes(more, k))
            new = {key: x for key, x in after.items() if before.get(key, 0.0) != x}
            if new:
                self._joint(joints[name].child, new)

    def _place(self, joint: FileJoint, rotation: spatial.Array, position: spatial.Array) -> None:
        """Where a body stands in its parent, from where its link does at joint angle zero."""
        m, element = self.file.compiled, self._element(joint.child)
        if element.parent is not None and element.parent.tag not in ("body", "worldbody"):
            raise ModelError(
                f"{self.file.path}: body '{joint.child}' stands in a <{element.parent.tag}>, which "
                "moves it; write its pos and quat into it"
            )
        body, parent = m.body(joint.child).id, m.body(joint.parent).id
        way, anchor = self.file.zero(body) * joint.axis, self.file.anchor
        turn = rotation @ spatial.exp_rotation(way) if joint.kind == "revolute" else rotation
        place = position + anchor[parent] - turn @ anchor[body]
        if joint.kind == "prismatic":
            place = place + rotation @ way
        self.xml.set(element, "pos", number_text(place))
        self.xml.set(element, "quat", number_text(spatial.quaternion_from_matrix(turn)))
        for key in OTHER_TURNS:
            self.xml.drop(element, key)

    def _body(self, name: str, theta: spatial.Array) -> None:
        """<inertial> of a body, from θ (10,) in its link's frame."""
        element, body = self._element(name), self.file.compiled.body(name).id
        mass, com, tensor = body_from_theta(move_theta(theta, np.eye(3), self.file.anchor[body]))
        moments, axes = principal(tensor)
        told = {"pos": com, "quat": axes, "mass": mass, "diaginertia": moments}
        values = {key: number_text(value) for key, value in told.items()}
        inertial = element.child("inertial")
        if inertial is None:
            texts = " ".join(f'{key}="{value}"' for key, value in values.items())
            self.xml.insert(element, f"<inertial {texts}/>")
            return
        for key, value in values.items():
            self.xml.set(inertial, key, value)
        for key in (*OTHER_TURNS, "fullinertia"):
            self.xml.drop(inertial, key)

    def _joint(self, body: str, values: dict[str, float | list[float]]) -> None:
        element = self._element(body)
        joint = element.child("joint")
        if joint is None:
            raise ModelError(f"{self.file.path}: no <joint> stands in body '{body}' itself")
        said = [x.attributes.get("angle") for x in self.xml.root.children if x.tag == "compiler"]
        for key, value in values.items():
            degrees = key == "springref" and "radian" not in said
            self.xml.set(joint, key, number_text(np.degrees(value) if degrees else value))

    def _element(self, body: str) -> Element:
        for element in self.xml.root.walk():
            if element.tag == "body" and element.attributes.get("name") == body:
                return element
        raise ModelError(
            f"{self.file.path}: body '{body}' does not stand in this file under a name; name it "
            "there, or give the file that it stands in"
        )
