"""A learned model written onto its robot's URDF: numbers in their places, no other byte."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.effects.robots import robot_urdf
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.model.model_file import dumps, loads
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel, Tool
from adapter.model.spatial import exp_rotation, matrix_from_zxz, zxz_from_matrix
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.robot_models import (
    PANDA,
    file_of,
    pin_model,
    random_urdf,
    read_quietly,
    relative,
)

# What a real robot's file has beside its dynamics: a world, pictures, fingers of which one
# follows the other, a camera, transmissions, a simulator's tags, comments and an own spacing.
DRESSED = file_of("dressed.urdf")
EMPTY = re.compile(r"<link name=\"(\w+)\"(\s*/>|>\s*</link>)")
NEW = re.compile(
    r"\s*<(inertial>.*?</inertial>|origin [^>]*/>|dynamics [^>]*/>|!-- adapter export: .*?-->)",
    re.DOTALL,
)


def learned(model: SelfModel, seed: int = 0) -> SelfModel:
    """The model with every frame and body a bit elsewhere, as learning leaves it."""
    rng = np.random.default_rng(seed)
    turns = exp_rotation(rng.normal(size=(model.tree.n, 3)) * 0.02)
    lam = np.c_[
        zxz_from_matrix(turns @ matrix_from_zxz(model.lam[:, :3])),
        model.lam[:, 3:] + rng.normal(size=(model.tree.n, 3)) * 5e-3,
    ]
    theta = model.theta * (1.0 + 0.05 * rng.uniform(-1, 1, (model.tree.bodies, 1)))
    theta[:, 4:] *= 1.02
    return replace(model, lam=lam, theta=theta, name=f"{model.name} (learned)")


def skeleton(text: str) -> str:
    """A URDF without inertials, origins, <dynamics> and our comment: what has to stay."""
    return EMPTY.sub(r"<link \1>", NEW.sub("", text))


def same_arm(text: str, model: SelfModel) -> None:
    """The arm in a URDF is the model's: frames and torques, by our reader."""
    back, rng = read_quietly(text, model.tree.floating), np.random.default_rng(1)
    moved = rng.uniform(-1.5, 1.5, (3, 20, model.tree.n))
    assert back.tree.joint_names == model.tree.joint_names
    np.testing.assert_allclose(back.joint_rotation(), matrix_from_zxz(model.lam[:, :3]), atol=1e-12)
    np.testing.assert_allclose(back.lam[:, 3:], model.lam[:, 3:], atol=1e-12)
    np.testing.assert_allclose(back.theta, model.theta_with_tool(), atol=1e-11)
    if not model.tree.floating:
        loaded = replace(model, effects=(), theta=model.theta_with_tool(), tool=None)
        assert relative(RigidArm.of(back).torque(*moved), RigidArm.of(loaded).torque(*moved)) < 1e-9


@pytest.mark.parametrize("crlf", [False, True], ids=["lf", "crlf"])
def test_a_robot_keeps_all_but_the_numbers_that_were_learned(crlf: bool) -> None:
    text = DRESSED.replace("\n", "\r\n") if crlf else DRESSED
    model = learned(read_quietly(text))
    written = robot_urdf(model)
    assert written.onto == "URDF" and written.notes == ()
    assert skeleton(written.text) == skeleton(text)
    assert written.text.count("\r\n") == crlf * written.text.count("\n")
    same_arm(written.text, model)
    for kept in (
        '<visual name="a > b"><origin xyz="0 0 0.250"/>',
        '<mass value = "',
        'rpy="0.3 -0.2 1"',
        '<mass value="0.3"/>',
        "izz='0.0",
    ):
        assert kept in written.text  # spacing, quotes, the axes of a tensor, a link that rides
    model_2 = loads(dumps(model))
    assert robot_urdf(model_2).text == written.text


def test_xacro_and_other_encodings_are_said(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"is xacro yet; .*xacro FILE > arm\.urdf"):
        read_quietly('<robot name="r" xmlns:xacro="http://x/xacro"><xacro:arm/></robot>')
    path = tmp_path / "latin.urdf"
    path.write_bytes(DRESSED.replace("utf-8", "iso-8859-1").encode("iso-8859-1"))
    with pytest.raises(ModelError, match=r"latin\.urdf: not text in UTF-8 .*save it as UTF-8"):
        robot_urdf(read_quietly(DRESSED), onto=path)


def test_what_was_not_learned_anew_is_not_written_anew() -> None:
    """The documented model onto its file: every byte, but for links that PyBullet would load."""
    written = robot_urdf(read_quietly(DRESSED)).text
    assert written.count('<mass value="0"/>') == 1  # of the flange
    nothing = re.compile(r"\s*<inertial>\s*<mass value=\"0\"/>.*?</inertial>", re.DOTALL)
    assert EMPTY.sub(r"<link \1>", nothing.sub("", written)) == EMPTY.sub(r"<link \1>", DRESSED)
    whole = read_quietly(DRESSED)
    one = replace(whole, lam=whole.lam + np.eye(2, 6, k=3) * 0.01)
    changed = set(robot_urdf(one).text.splitlines()) - set(written.splitlines())
    assert all("<origin" in line for line in changed) and len(changed) == 2


OTHERS = {
    "panda": PANDA.read_text(),
    "default namespace": DRESSED.replace("<robot ", '<robot xmlns="http://www.ros.org" '),
    "tree17": random_urdf(17, seed=3),
    "tree5 floating": random_urdf(5, seed=3),
}


@pytest.mark.parametrize("robot", OTHERS)
def test_other_robots_keep_all_but_the_numbers(robot: str) -> None:
    text = OTHERS[robot]
    model = learned(read_quietly(text, "floating" in robot), seed=2)
    written = robot_urdf(model).text
    assert skeleton(written) == skeleton(text)
    same_arm(written, model)


def test_friction_that_was_learned_stands_in_dynamics_and_other_stays() -> None:
    model = read_quietly(DRESSED)
    viscous = {"effect": "viscous_friction", "joints": [1, 2], "parameters": {"Fv": [0.25, 0.0]}}
    text = robot_urdf(replace(model, effects=(viscous,))).text
    assert '<dynamics friction="0.5" damping="0.25"/>' in text
    assert text.count("<dynamics") == 1
    ripple = {"effect": "torque_offset", "joints": [1], "parameters": {"o": 0.3}}
    both = robot_urdf(replace(model, effects=(viscous, ripple)))
    (said,) = re.findall(r"\n  <!-- adapter export: .*?-->", both.text, re.DOTALL)
    assert both.text.replace(said, "") == text and both.left_out == ("torque_offset",)
    assert "viscous friction: whole\n    torque sensor offset: no\n      j1: o = 0.3 N m" in said
    assert robot_urdf(replace(read_quietly(both.text), effects=(viscous, ripple))).text == both.text


def test_tool_load_encoder_and_tilt_are_in_the_numbers() -> None:
    """The arm takes the torque of the model, all its effects included."""
    tool = Tool(0.8, np.array([0.01, 0.0, 0.05]), np.diag([1e-3, 2e-3, 2.5e-3]))
    effects = (
        {"effect": "payload", "parameters": {"m": 0.5, "cx": 0.0, "cy": 0.01, "cz": 0.1}},
        {"effect": "encoder_offset", "joints": [2], "parameters": {"o": 0.02}},
        {"effect": "base_tilt", "joints": [], "parameters": {"rx": 0.3, "ry": -0.2}},
    )
    model = replace(read_quietly(DRESSED), tool=tool, effects=effects)
    written = robot_urdf(model)
    back, moved = read_quietly(written.text), np.random.default_rng(0).uniform(-1, 1, (3, 9, 2))
    assert relative(ModelTorque(back)(*moved), ModelTorque(model)(*moved)) < 1e-9
    assert skeleton(written.text) == skeleton(DRESSED)
    assert "the tool of 0.8 kg is in link 'b'" in written.notes


def test_a_finger_without_a_mass_gets_a_gram_of_its_carrier() -> None:
    """A simulator moves it, and PyBullet would take 1 kg for it."""
    right = DRESSED[DRESSED.index('<link name="right">') :].partition("</link>")[0] + "</link>"
    text = DRESSED.replace(right, '<link name="right"/>')
    model = learned(read_quietly(text))
    written = robot_urdf(model).text
    assert '<mass value="0.001"/>' in written
    same_arm(written, model)


@pytest.mark.parametrize("mass", [0.2, 1.2, 2.8])
def test_links_that_ride_keep_their_weight_while_their_carrier_can_exist(mass: float) -> None:
    model = read_quietly(DRESSED)
    theta = model.theta.copy()
    theta[0] *= mass / 2.8  # documented: 2.5 kg and a camera of 0.3
    written = robot_urdf(replace(model, theta=theta))
    same_arm(written.text, replace(model, theta=theta))
    oracle = pin_model(written.text)
    assert oracle.inertias[1].mass == pytest.approx(mass)
    kept = '<mass value="0.3"/>' in written.text
    assert kept == (mass > 1.0) == (not written.notes)
    if not kept:
        assert "camera" in written.notes[0] and "times as heavy" in written.notes[0]
    found = re.findall(r'<mass value ?= ?"([^"]*)"', written.text)
    assert min(float(x) for x in found if float(x)) > 0.01


CHANGED = {
    "origin": ("0 0.05 0.3", "0 0.05 0.32", r"origin of joint 'j1' is .* moved by 0.02 m"),
    "turn": ("0 0.5 0", "0 0.6 0", r"origin of joint 'camera_mount' is turned by 0.1 rad"),
    "axis": ("0.6 0 0.8", "0 0 1", r"joint 'j2' turns about"),
    "lacks": ('name="j2"', 'name="elbow"', r"joint 'j2', asked for, is not there; .*elbow"),
    "other name": ("camera_mount", "mount", r"lacks joint 'camera_mount' .* has joint 'mount'"),
    "other link": ('t link="camera"', 't link="foot"', r"'j2' joins 'world' and 'b', was 'a'"),
}


@pytest.mark.parametrize("what", CHANGED)
def test_a_file_that_changed_is_refused_with_the_difference(what: str, tmp_path: Path) -> None:
    before, after, message = CHANGED[what]
    assert DRESSED.count(before) == 1
    path = tmp_path / "changed.urdf"
    path.write_text(DRESSED.replace(before, after))
    model = learned(read_quietly(DRESSED))
    with pytest.raises(ModelError, match=rf"(?s)changed\.urdf.*{message}"):
        robot_urdf(model, onto=path)


def test_limits_pictures_and_masses_may_have_changed(tmp_path: Path) -> None:
    path = tmp_path / "new.urdf"
    path.write_text(
        DRESSED.replace('effort="80"', 'effort="90"')
        .replace("foot.dae", "foot.stl")
        .replace("2.50", "3")
    )
    model = learned(read_quietly(DRESSED))
    written = robot_urdf(model, onto=path)
    assert 'effort="90"' in written.text and "foot.stl" in written.text
    same_arm(written.text, model)


def test_a_model_without_its_file_is_compared_by_its_joints() -> None:
    model = replace(learned(documented("panda")), source=None)
    written = robot_urdf(model, onto=PANDA)
    assert "compared by its joints alone" in written.notes[0]
    same_arm(written.text, model)
    assert (
        robot_urdf(model).onto is None
        and robot_urdf(model).text == robot_urdf(model, alone=True).text
    )
