"""MJCF in, and a learned model back onto it, judged by MuJoCo."""

from __future__ import annotations

import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from adapter.effects.robots import read_robot, robot_mjcf
from adapter.effects.torque import ModelTorque
from adapter.errors import MeansError, ModelError, ModelWarning
from adapter.model.model_file import load_model, save_model
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, matrix_from_zxz
from tests.helpers.robot_models import file_of
from tests.model.test_onto import learned

# Degrees, defaults, joints beside their body's origin, a zero elsewhere, bodies whose mass comes
# from their shape, a finger on a tendon, and things that lie about.
ARM = file_of("bench_arm.xml")
DEFAULTS = """<mujocoinclude><default><default class="arm">
<joint damping="0.4" frictionloss="0.2"/></default></default></mujocoinclude>"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    (tmp_path / "defaults.xml").write_text(DEFAULTS)
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


def quietly(path: Path, joints: list[str] | None = None) -> SelfModel:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return read_robot(path, joints)


def judged(path: Path, model: SelfModel) -> None:
    """MuJoCo's torques and places of links are the model's; what is locked stands still."""
    oracle = mujoco.MjModel.from_xml_path(str(path))
    off = mujoco.mjtDisableBit
    oracle.opt.disableflags |= off.mjDSBL_LIMIT | off.mjDSBL_CONTACT
    data, n, rng = mujoco.MjData(oracle), model.tree.n, np.random.default_rng(0)
    dofs = [oracle.joint(name).dofadr[0] for name in model.tree.joint_names]
    at = [oracle.joint(name).qposadr[0] for name in model.tree.joint_names]
    for joint in range(oracle.njnt):  # all else at zero
        if oracle.jnt_type[joint] != 0:
            data.qpos[oracle.jnt_qposadr[joint]] = 0.0
    for _ in range(8):
        q, dq, ddq = rng.uniform(-1, 1, (3, n))
        dq += np.sign(dq)  # where dry friction slides
        data.qpos[at], data.qvel[dofs], data.qacc[dofs] = q, dq, ddq
        mujoco.mj_inverse(oracle, data)
        ours = ModelTorque(model)(q[None], dq[None], ddq[None])[0]
        np.testing.assert_allclose(ours, data.qfrc_inverse[dofs], atol=1e-6)
        mujoco.mj_kinematics(oracle, data)
        base = data.body(model.tree.base_name)
        place = pose(base.xmat.reshape(3, 3), base.xpos)
        for k, name in enumerate(model.tree.joint_names):  # a chain
            turn = matrix_from_zxz(model.lam[k, :3]) @ exp_rotation([0, 0, q[k]])
            place = place @ pose(turn, model.lam[k, 3:])
            joint = data.joint(name)
            np.testing.assert_allclose(place[:3, 3], joint.xanchor, atol=1e-9)
            np.testing.assert_allclose(place[:3, 2], joint.xaxis, atol=1e-9)


def pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    return np.block([[rotation, position[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def test_an_arm_is_read_as_mujoco_means_it(arm: Path) -> None:
    with pytest.warns(ModelWarning) as caught:
        model = read_robot(arm)
    said = " ".join(str(w.message) for w in caught)
    for part in ("tendon 'cord'", "free body 'cube'"):
        assert f"{part} is not used" in said
    assert "joint 'grip' is prismatic, of a gripper as it seems" in said
    assert model.name == "bench arm" and model.tree.base_name == "stand"
    assert model.tree.joint_names == ("shoulder", "elbow")
    assert model.tree.link_names == ("upper", "lower")
    assert [frame.name for frame in model.frames] == ["bracket", "finger"]
    np.testing.assert_allclose(model.limits.lower[0], -np.pi / 2)
    assert np.isnan(model.limits.lower[1]) and model.limits.effort[1] == 60.0
    assert np.linalg.norm(model.gravity) == pytest.approx(9.8)
    assert {e["effect"] for e in model.effects} == {
        *("viscous_friction", "coulomb_friction", "motor_inertia", "joint_spring")
    }
    judged(arm, model)


MORE = """<sensor><jointpos joint="elbow"/><jointvel joint="elbow"/></sensor>
  <keyframe><key name="home" qpos="0 0 0 0 0 1 1 0 0 0"/></keyframe>
  <equality><connect body1="stand" body2="finger" anchor="0 0 0" name="glue"/></equality>"""


def test_parts_of_which_an_arm_makes_no_use_are_said(arm: Path) -> None:
    ball = '<body name="wrist"><joint name="turn" type="ball"/><geom size="0.01"/></body></body>'
    text = ARM.replace("</mujoco>", f"{MORE}</mujoco>").replace(
        '<body name="cube"', '<body name="ghost" mocap="true"/><body name="cube"'
    )
    arm.write_text(
        text.replace('<geom type="sphere" size="0.02"/>', "")
        .replace(
            '<joint name="grip" type="slide" axis="1 0 0" ref="0.01" range="0 0.02"/>',
            f'<joint name="grip" type="slide" axis="1 0 0"/><geom size="0.02"/>{ball[:-7]}',
        )
        .replace('qpos="0 0 0 0 0 1 1 0 0 0"', 'qpos="0 0 0 1 0 0 0 0 0 0 1 0 0 0"')
    )
    with pytest.warns(ModelWarning) as caught:
        read_robot(arm)
    said = " ".join(str(w.message) for w in caught)
    for part in (
        *("equality 'glue'", "mocap body 'ghost'", "sensors (2)", "keyframes (1)"),
        "actuators, but for the torque that they can give, (1)",
    ):
        assert f"{part} is not used" in said
    assert "joint 'turn' is ball; locked at zero" in said


def test_a_learned_arm_goes_back_into_its_file(arm: Path, tmp_path: Path) -> None:
    model = quietly(arm)
    effects = (
        {"effect": "viscous_friction", "joints": [1, 2], "parameters": {"Fv": [0.7, 0.4]}},
        {"effect": "motor_inertia", "joints": [1, 2], "parameters": {"B": [0.05, 0.3]}},
        {"effect": "coulomb_friction", "joints": [1, 2], "parameters": {"Fc": 0.2}},
        {"effect": "joint_spring", "joints": [2], "parameters": {"k": 1.5, "q0": 0.3}},
        {"effect": "law: dq³", "joints": [2], "parameters": {"c": 0.4}},
    )
    found = replace(learned(model, 3), theta=model.theta * 1.1, effects=effects)
    written = robot_mjcf(load_model(save_model(found, tmp_path / "model.json")))
    (note,) = written.notes
    assert written.onto == str(arm) and "from version 4 on" in note
    new = tmp_path / "new.xml"
    new.write_text(written.text)
    judged(new, found)
    number = re.compile(
        r'\n\s*<inertial.*/>|(armature|damping|springref|stiffness|pos|quat|euler)="[^"]*"|[ ]'
    )
    assert number.sub("", written.text) == number.sub("", ARM)
    assert 'frictionloss="0.2"' not in written.text  # the default says it
    gone = replace(quietly(new), effects=({**effects[-1], "parameters": {"c": 0.0}},))
    assert re.findall(r'damping="(.*?)"', robot_mjcf(gone, new).text)[-1] == "0.4"


def test_what_was_not_learned_anew_is_not_written_anew(arm: Path) -> None:
    assert robot_mjcf(quietly(arm)).text == ARM


def test_a_file_that_changed_is_refused_and_one_that_is_gone_is_said(arm: Path) -> None:
    model = quietly(arm)
    arm.write_text(ARM.replace('pos="0 0 0.3"', 'pos="0 0 0.35"'))
    with pytest.raises(ModelError, match=r"origin of joint 'elbow' is .* moved by 0.05 m"):
        robot_mjcf(model)
    arm.unlink()
    written = robot_mjcf(model)
    assert written.onto is None and "is not there" in written.notes[0]
    with pytest.raises(ModelError, match=r"arm\.xml: cannot be read"):
        robot_mjcf(model, onto=arm)


def test_a_compiler_that_overrides_inertias_is_refused(arm: Path) -> None:
    arm.write_text(ARM.replace('angle="degree"', 'angle="degree" inertiafromgeom="true"'))
    model = quietly(arm)
    with pytest.raises(ModelError, match="inertiafromgeom"):
        robot_mjcf(replace(model, theta=model.theta * 1.1))


BAD = {
    "two joints": ('<joint name="shoulder"', '<joint name="x"/><joint name="shoulder"', "2 joints"),
    "not MJCF": ("mujoco", "robot", "top element is <robot>.* a URDF's name ends in .urdf"),
    "not XML": ("</mujoco>", "", "not XML"),
    "no such geom": ('type="capsule"', 'type="tube"', "MuJoCo cannot read it"),
    "no hinge": ('name="elbow"', 'name="elbow" type="ball"', "joint 'elbow'.* is ball"),
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_read_is_said_in_one_sentence(what: str, arm: Path) -> None:
    before, after, message = BAD[what]
    arm.write_text(ARM.replace(before, after))
    with pytest.raises(ModelError, match=message) as caught:
        quietly(arm, ["shoulder", "elbow"])
    assert "arm.xml" in str(caught.value) and "\n" not in str(caught.value)


def test_a_floating_robot_is_the_free_body_that_carries_joints(arm: Path) -> None:
    arm.write_text(
        ARM.replace(
            '<body name="stand" pos="0 0 1" euler="20 0 0">',
            '<body name="stand" pos="0 0 1"><freejoint/>',
        )
    )
    with pytest.warns(ModelWarning, match="free body 'cube' is not used"):
        model = read_robot(arm, floating=True)
    assert model.tree.floating and model.tree.base_name == "stand" and model.tree.n == 2
    with pytest.raises(ModelError, match="no joint is left to move"):
        quietly(arm)


def test_without_mujoco_the_extra_is_named(arm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MeansError, match=r"panda-adapter\[mujoco\]"):
        read_robot(arm)
