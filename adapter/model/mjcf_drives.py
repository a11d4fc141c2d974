"""Position-controlled drives in an MJCF: MuJoCo's actuators, how its joints stick, the ground.

MuJoCo's friction is a constraint that gives way a little. Written so stiff, and with so short a
time, that a joint at rest creeps by microradians per second, it holds as dry friction does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from adapter import optional
from adapter.errors import MeansError, ModelError
from adapter.model.mjcf import compiled_mjcf
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, matrix_from_quaternion, quaternion_from_matrix, z_to_axis
from adapter.model.urdf_text import number_text
from adapter.model.xml_edit import Element, XmlText

# behind a joint's name: the actuator that takes its command's speed, and the one that takes from
# friction, which MuJoCo has as one number, what it loses once the joint slides
SPEED, SLIDES = "_speed", "_slides"
STEP_S = 5e-4  # of an arm alone, by Runge and Kutta
QUICKEST, QUICK_STEP_S = 0.5, 1e-4  # damping over inertia times the step, from which on the second
FINEST_S = 5e-5  # step for which an actuator still remembers enough of its commands
# MuJoCo takes two of its steps where this time (s) is shorter: whatever the file's step is
STICKS = {"solreffriction": "0.0001 1", "solimpfriction": "0.9999 0.9999 0.001 0.5 2"}
PLATE_M = 1.0, 1.0, 0.2  # half the sides of what stands for the ground
BALL_M = 1e-5  # radius of what touches it
HARD, HARDER = "0.99 0.99 0.001 0.5 2", 30.0  # MuJoCo's impedance of a contact; than the springs
QUICK_S, DAMPED = 1e-3, 0.02
UNEQUAL = 1e-9  # N m/rad, that moves nothing


class Floor(NamedTuple):
    """Something level that carries an arm.

    Attributes:
        link: (from 0) that touches it; point: (3,) m, where, in that link's frame.
        up: (3,) unit vector, base axes; height: m, over the base's origin; stiffness: N/m.
        friction: coefficient.
    """

    link: int
    point: Array
    up: Array
    height: float
    stiffness: float
    friction: float


@dataclass(frozen=True, eq=False)
class Drives:
    """Position drives of an arm, (n,) each; friction and motors' inertia are the model's effects.

    Attributes:
        position_gain, velocity_gain: N m/rad, N m s/rad; effort: N m, infinite where unknown.
        feeds_speed: whether the velocity gain acts on the command's speed less the joint's.
        quickness: damping over inertia, 1/s.
        static: N m, of friction that is gone, in a line, at a speed of `slip`, rad/s.
        delay_s: from a command until it acts; floor: that the arm comes down on, if any.
    """

    position_gain: Array
    velocity_gain: Array
    effort: Array
    feeds_speed: NDArray[np.bool_]
    quickness: Array
    static: Array
    slip: Array
    delay_s: float = 0.0
    floor: Floor | None = None


def with_drives(
    text: str, model: SelfModel, drives: Drives, onto: Path | None
) -> tuple[str, list[str]]:
    """An MJCF of an arm with its drives, and notes on it in words.

    Args:
        text: of the MJCF, with all joints of the model by name.
        onto: the file that it is a new text of; None: the arm alone.

    Raises:
        ModelError: a joint or link does not stand in the text, or MuJoCo does not take the result.
        MeansError: a floor, or a file, and MuJoCo is not installed.
    """
    writer = _Writer(XmlText(text, str(onto or model.name)), model, drives, onto)
    return writer.written()


class _Writer:
    def __init__(self, xml: XmlText, model: SelfModel, drives: Drives, onto: Path | None) -> None:
        self.xml, self.model, self.drives, self.onto = xml, model, drives, onto
        self.notes: list[str] = []
        self.there = xml.root.walk()
        self.compiled: Any = None
        if onto is not None or drives.floor is not None:
            self.compiled = self._read(xml.text())
        if onto is None:
            quick = STEP_S * float(drives.quickness.max()) > QUICKEST
            self.step_s = QUICK_STEP_S if quick else STEP_S
        else:
            self.step_s = float(self.compiled.opt.timestep)

    def written(self) -> tuple[str, list[str]]:
        """The text and the notes."""
        if self.onto is None:
            option = next(x for x in self.there if x.tag == "option")
            self.xml.set(option, "timestep", number_text(self.step_s))
            way = "RK4" if self.step_s == STEP_S else "implicitfast"
            self.xml.set(option, "integrator", way)
            if self.drives.floor is not None:
                self.xml.set(option, "cone", "elliptic")
        for name in self.model.tree.joint_names:
            for key, value in STICKS.items():
                self.xml.set(self._named("joint", name), key, value)
        self._actuators()
        if self.drives.floor is not None:
            self._floor(self.drives.floor)
        text = self.xml.text()
        if self.compiled is not None:
            self._read(text)
        return text, self.notes

    def _read(self, text: str) -> Any:
        """MuJoCo's model of a text. Raises ModelError, MeansError."""
        mujoco = optional.load("mujoco")
        if self.onto is not None:
            return compiled_mjcf(self.onto, text)
        try:
            return mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            said = " ".join(str(error).split())
            raise ModelError(f"{self.model.name}: MuJoCo cannot read it ({said})") from None

    def _named(self, tag: str, name: str) -> Element:
        for element in self.there:
            if element.tag == tag and element.attributes.get("name") == name:
                return element
        raise ModelError(f"{self.onto}: no <{tag} name='{name}'> stands in this file itself")

    def _actuators(self) -> None:
        """One for each joint's position, in the place of its old one; behind, one for its speed."""
        drives, late, reach = self.drives, self._delay(), self.model.limits
        there = [x for x in self.there if x.parent and x.parent.tag == "actuator"]
        new, more, steered, gone = [], list[str](), list[str](), list[Element]()
        for k, name in enumerate(self.model.tree.joint_names):
            fed, kv = bool(drives.feeds_speed[k]), float(drives.velocity_gain[k])
            facts = {"name": name, "joint": name, "kp": float(drives.position_gain[k])}
            facts |= {"kv": 0.0 if fed else kv}
            ends = [reach.lower[k], reach.upper[k]], drives.effort[k] * np.array([-1.0, 1.0])
            ranges = dict(zip(("ctrlrange", "forcerange"), ends, strict=True))
            facts |= {key: x for key, x in ranges.items() if np.isfinite(x).all()}
            old = [x for x in there if x.attributes.get("joint") == name]
            if old:
                kept = self._kept(old[0])  # but for a limit that was found
                facts = kept | facts | {"name": kept.get("name", name)}
                self.xml.replace(old[0], _element("position", facts | late))
            else:
                new.append(_element("position", facts | late))
                steered.append(name)
            for other in old[1:]:
                self.xml.replace(other, "")
            gone += old[1:]
            speed = {"name": name + SPEED, "joint": name, "kv": kv}
            more += [_element("velocity", speed | late)] if fed else []
            if drives.static[k] > 0.0:
                most = float(drives.static[k])
                eases: dict[str, Any] = {"name": name + SLIDES, "joint": name, "biastype": "affine"}
                # MuJoCo takes a positive third number for a damping ratio beside equal others
                eases |= {"gainprm": 0, "biasprm": [0.0, UNEQUAL, most / float(drives.slip[k])]}
                more.append(_element("general", eases | {"forcerange": [-most, most]}))
        for number, key in enumerate(x for x in self.there if x.tag == "key"):
            if "ctrl" in key.attributes:  # one number for each actuator
                told = zip(there, self.compiled.key_ctrl[number], strict=True)
                values = [float(x) for element, x in told if element not in gone]
                q, joint = self.compiled.key_qpos[number], self.compiled.joint
                values += [float(q[joint(name).qposadr[0]]) for name in steered]
                self.xml.set(key, "ctrl", number_text([*values, *[0.0] * len(more)]))
        self._add("actuator", [*new, *more])
        if drives.static.any():
            note = "friction falls with speed by actuators without a control, JOINT"
            self.notes.append(note + SLIDES)
        if drives.feeds_speed.any():
            note = "the servos use the command's speed, which MuJoCo does not derive: give it, "
            self.notes.append(f"{note}rad/s, to the actuators JOINT{SPEED}")

    def _kept(self, old: Element) -> dict[str, Any]:
        """Of an actuator that is written anew: its name, and the force that it can give."""
        if "name" not in old.attributes:
            return {}
        own = self.compiled.actuator(old.attributes["name"])
        force = {"forcerange": own.forcerange} if own.forcelimited[0] else {}
        return {"name": own.name, **force}

    def _delay(self) -> dict[str, Any]:
        """Attributes of an actuator that acts late; a note where MuJoCo has none."""
        delay_s = self.drives.delay_s
        if delay_s == 0.0:
            return {}
        try:
            known = hasattr(optional.load("mujoco").MjModel, "actuator_delay")
        except MeansError:
            known = False
        if not known:
            late = f"give commands {1e3 * delay_s:.2f} ms late"
            self.notes.append(f"the installed MuJoCo knows no delay of actuators: {late}")
            return {}
        # Between two samples by a line, a command begins to act half a step before its time.
        late_s = delay_s + 0.5 * self.step_s
        count = int(np.ceil(late_s / min(FINEST_S, self.step_s))) + 2
        return {"delay": late_s, "nsample": count, "interp": "linear"}

    def _floor(self, floor: Floor) -> None:
        """A plate on springs, and a ball at what touches it, which push one another alone."""
        model, compiled, tree = self.model, self.compiled, self.model.tree
        mujoco = optional.load("mujoco")
        data = mujoco.MjData(compiled)
        mujoco.mj_kinematics(compiled, data)
        base = max(mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_BODY, tree.base_name), 0)
        up = matrix_from_quaternion(data.xquat[base]) @ floor.up
        place = data.xpos[base] + (floor.height - BALL_M) * up
        anchor = compiled.joint(tree.joint_names[floor.link]).pos
        point = anchor + z_to_axis(model.axis[floor.link]) @ floor.point
        quat, apart = quaternion_from_matrix(z_to_axis(up)), {"contype": 0, "conaffinity": 0}
        names = "found_ground", "touches_found_ground"
        # MuJoCo's own contacts are springs only where they hardly hold, and then do not rub: so the
        # springs are joints, and what touches is hard: the more, the quicker and the heavier the
        # plate, which as light as it may be hits little
        quick_s = max(2.0 * self.step_s, QUICK_S)
        mass = HARDER * floor.stiffness * quick_s**2
        damping = 2.0 * DAMPED * np.sqrt(floor.stiffness * mass)
        spring = {"type": "slide", "stiffness": floor.stiffness, "damping": damping}
        plate = {"name": names[0], "type": "box", "size": PLATE_M, "mass": mass}
        inside = [_element("joint", spring | {"axis": axis}) for axis in np.eye(3)]
        inside.append(_element("geom", plate | {"pos": [0.0, 0.0, -PLATE_M[2]]} | apart))
        body = _element("body", {"name": names[0], "pos": place, "quat": quat, "gravcomp": 1})
        world = next(x for x in self.there if x.tag == "worldbody")
        self.xml.insert(world, "\n".join([body.replace("/>", ">"), *inside, "</body>"]))
        for key in (x for x in self.there if x.tag == "key" and "qpos" in x.attributes):
            self.xml.set(key, "qpos", key.attributes["qpos"] + " 0 0 0")
        ball = {"name": names[1], "type": "sphere", "size": BALL_M, "mass": 0, "pos": point}
        hand = self._named("body", tree.link_names[floor.link])
        self.xml.insert(hand, _element("geom", ball | apart))
        pair: dict[str, Any] = {"geom1": names[0], "geom2": names[1], "condim": 1}
        pair |= {"solref": [quick_s, 1.0], "solimp": HARD}
        if floor.friction > 0.0:
            pair |= {"condim": 3, "friction": [floor.friction] * 2 + [0.0] * 3}
        self._add("contact", [_element("pair", pair)])
        if self.onto is not None:
            self.notes.append(
                "the ground is a plate on springs: three numbers more in qpos, the last ones; it "
                'rubs as our simulation has it with cone="elliptic" in <option>'
            )

    def _add(self, tag: str, lines: list[str]) -> None:
        """Elements into a section, which may have to be made."""
        section = self.xml.root.child(tag)
        if section is not None and lines:
            self.xml.insert(section, "\n".join(lines))
        elif lines:
            inside = (f"  {line}" for line in lines)
            self.xml.insert(self.xml.root, "\n".join([f"<{tag}>", *inside, f"</{tag}>"]))


def _element(tag: str, facts: dict[str, Any]) -> str:
    told = ((k, x if isinstance(x, str | int) else number_text(x)) for k, x in facts.items())
    return f"<{tag} {' '.join(f'{key}={quoteattr(str(value))}' for key, value in told)}/>"
