"""URDF in and out, judged by Pinocchio; what can't be read is refused in one sentence."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from adapter.effects.robots import robot_urdf
from adapter.errors import ModelError, ModelWarning
from adapter.model.model_file import save_model
from adapter.model.robots import documented, names
from adapter.model.self_model import SelfModel, Tool
from adapter.model.urdf import model_from_urdf, read_urdf
from tests.helpers.robot_models import (
    PANDA,
    ROBOTS,
    machine_urdf,
    pin_model,
    pinocchio_case,
    read_quietly,
    relative,
    set_angles,
    shared,
    urdf_text,
)


@pytest.mark.parametrize("floating", [False, True], ids=["fixed", "floating"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_round_trip_keeps_pinocchios_torques_and_frames(robot: str, floating: bool) -> None:
    text = urdf_text(robot)
    model = read_quietly(text, floating)
    written = robot_urdf(model, alone=True).text
    again = read_quietly(written, floating)
    np.testing.assert_allclose(again.theta, model.theta, atol=1e-12)
    np.testing.assert_allclose(again.axis, model.axis, atol=1e-15)
    before = pinocchio_case(text, floating)
    after = pinocchio_case(written, floating)
    assert relative(after.tau, before.tau) < 1e-9
    _same_frames(pin_model(text), pin_model(written))


def _same_frames(before: pin.Model, after: pin.Model) -> None:
    """Every link, moving or not, is where it was, at a random posture."""
    places = []
    names_kept = [frame.name for frame in before.frames if after.existFrame(frame.name)]
    assert len(names_kept) == before.nframes
    for oracle in (before, after):
        data, q = oracle.createData(), pin.neutral(oracle)
        names = sorted(set(oracle.names) - {"universe"})
        set_angles(oracle, q, names, np.random.default_rng(0).uniform(-2, 2, len(names)))
        pin.framesForwardKinematics(oracle, data, q)
        places.append([data.oMf[oracle.getFrameId(name)].homogeneous for name in names_kept])
    np.testing.assert_allclose(places[0], places[1], atol=1e-10)


def test_our_panda_is_the_documented_one() -> None:
    reference = read_urdf(shared("models/panda_gaz2019.urdf"))
    ours = documented("panda")
    for key in ("lam", "theta", "base_theta", "axis"):
        np.testing.assert_array_equal(getattr(ours, key), getattr(reference, key))
    for key in ("lower", "upper", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(ours.limits, key), getattr(reference.limits, key))
    assert ours.tree.parent == (-1, 0, 1, 2, 3, 4, 5)
    assert [frame.name for frame in ours.frames] == ["panda_link8"]
    assert ours.lambda_source == "documentation"


def test_fixed_links_are_merged() -> None:
    """The hand's 0.73 kg count with link 7; its frame is remembered."""
    bare = documented("panda")
    held = documented(shared("models/panda_gaz2019_hand.urdf"))
    assert held.theta[6, 0] == pytest.approx(bare.theta[6, 0] + 0.73)
    hand = {frame.name: frame for frame in held.frames}["panda_hand"]
    assert hand.parent == "panda_link7"
    np.testing.assert_allclose(hand.position, [0, 0, 0.107])


def test_pybullets_panda_has_its_fingers_locked() -> None:
    data = pytest.importorskip("pybullet_data")
    path = Path(data.getDataPath()) / "franka_panda" / "panda.urdf"
    with pytest.warns(ModelWarning) as caught:
        model = read_urdf(path)
    said = [str(w.message) for w in caught]
    assert all("prismatic" in s and "locked at zero" in s for s in said[:2])
    assert len(said) == 3 and "made up" in said[2] and "'panda_link1'" in said[2]
    assert "panda_finger_joint1" in said[0] and "panda_finger_joint2" in said[1]
    assert model.tree.joint_names == tuple(f"panda_joint{k}" for k in range(1, 8))
    assert model.theta[6, 0] == pytest.approx(0.2 + 0.81 + 0.1 + 0.1)
    asked = [*model.tree.joint_names, "panda_finger_joint1"]
    with pytest.warns(ModelWarning, match="made up"):
        free = read_urdf(path, joints=asked, lock={"panda_finger_joint2": 0.01})
    assert free.tree.joint_names == tuple(asked) and free.tree.slides == (*7 * (False,), True)
    assert free.theta[7, 0] == pytest.approx(0.1) and free.limits.upper[7] == 0.04


def test_joints_not_asked_for_are_locked() -> None:
    wanted = [f"panda_joint{k}" for k in (2, 4)]
    with pytest.warns(ModelWarning, match="panda_joint7.*locked at zero"):
        model = documented("panda", joints=wanted)
    assert model.tree.joint_names == tuple(wanted)
    whole = documented("panda")
    total = whole.theta[:, 0].sum() + whole.base_theta[0]
    assert model.theta[:, 0].sum() + model.base_theta[0] == pytest.approx(total)


@pytest.mark.parametrize(
    ("robot", "free"), [("rail", 7), ("scara", 4), ("gantry", 4), ("gripper", 4)]
)
def test_what_slides_is_free_but_for_fingers(robot: str, free: int) -> None:
    model = model_from_urdf(machine_urdf(robot))
    assert model.tree.n == free
    whole = read_quietly(machine_urdf(robot))
    assert whole.theta[:, 0].sum() == pytest.approx(model.theta[:, 0].sum())


def test_a_tool_is_kept_apart_and_counts_in_the_torques() -> None:
    tool = Tool(0.8, np.array([0.01, 0.0, 0.05]), np.diag([1e-3, 2e-3, 2.5e-3]))
    model = replace(documented("panda"), tool=tool)
    assert model.theta_with_tool()[6, 0] == pytest.approx(model.theta[6, 0] + 0.8)
    np.testing.assert_array_equal(model.theta_with_tool()[:6], model.theta[:6])
    merged = model_from_urdf(robot_urdf(model, alone=True).text)
    np.testing.assert_allclose(merged.theta, model.theta_with_tool(), atol=1e-12)


@pytest.mark.parametrize("write", [partial(robot_urdf, alone=True), robot_urdf])
def test_an_impossible_body_is_not_exported(write: Callable[[SelfModel], object]) -> None:
    model = documented("panda")
    theta = model.theta.copy()
    theta[3, 4] = 1.0  # XX far above YY + ZZ
    with pytest.raises(ModelError, match=r"'panda_link4'.*impossible.*eigenvalue of -0\."):
        write(replace(model, theta=theta))
    theta[3] = 0.0
    with pytest.raises(ModelError, match=r"'panda_link4'.*eigenvalue of 0"):
        write(replace(model, theta=theta))


def test_with_base_is_there_and_back() -> None:
    model = documented("panda")
    floating = model.with_base(floating=True)
    np.testing.assert_array_equal(floating.theta, documented("panda", floating=True).theta)
    back = floating.with_base(floating=False)
    np.testing.assert_array_equal(back.theta, model.theta)
    np.testing.assert_array_equal(back.base_theta, model.base_theta)


MASS = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
LINK = "<link name='{}'>" + MASS + "</inertial></link>"
JOINT = "<joint name='{}' type='{}'><parent link='{}'/><child link='{}'/>{}</joint>"


def robot(*parts: str) -> str:
    """A URDF of links a, b, c and the given parts."""
    return "<robot name='r'>" + "".join(LINK.format(x) for x in "abc") + "".join(parts) + "</robot>"


AB = JOINT.format("ab", "revolute", "a", "b", "")
BC = JOINT.format("bc", "revolute", "b", "c", "")
FINE = robot(AB, BC)


def spoilt(was: str, now: str) -> str:
    assert was in FINE
    return FINE.replace(was, now)


def with_joint(name: str, kind: str, parent: str, child: str) -> str:
    return spoilt("</robot>", JOINT.format(name, kind, parent, child, "") + "</robot>")


BAD = {
    "planar": (spoilt(BC, BC.replace("revolute", "planar")), r"'bc'.*planar.*ab"),
    "two roots": (spoilt(BC, ""), r"2 root links \(a, c\)"),
    "two parents": (with_joint("ac", "fixed", "a", "c"), r"'c'.*'bc' and 'ac'"),
    "circle": (robot(BC, JOINT.format("cb", "fixed", "c", "b", "")), r"links .* form a loop"),
    "massless": (
        with_joint("cd", "revolute", "c", "d").replace("</robot>", "<link name='d'/></robot>"),
        r"moving link 'd' has no mass.*leave joint 'cd' out",
    ),
    "no name": (spoilt("link name='a'", "link"), r"a <link> has no 'name'"),
    "no type": (spoilt("name='bc' type='revolute'", "name='bc'"), r"'bc' has no 'type'"),
    "no child": (spoilt("<child link='c'/>", ""), r"'bc' has no <child"),
    "no mass value": (spoilt('mass value="1"', "mass"), r"'a' has no 'value'.*<mass>"),
    "no ixz": (spoilt('ixz="0"', ""), r"'a' has no 'ixz'.*<inertia>"),
    "no inertia": (spoilt(MASS, '<inertial><mass value="1"/>'), r"without <inertia>"),
    "negative": (spoilt('mass value="1"', 'mass value="-1"'), r"negative mass of -1"),
    "inertia below zero": (
        spoilt('izz="1"', 'izz="-1"'),
        r"moving link 'c' has a principal moment of inertia of -1 kg m².*below zero",
    ),
    "unknown link": (spoilt("child link='c'", "child link='z'"), r"'z'.*have.*a, b, c"),
    "unknown type": (spoilt("revolute", "spherical"), r"'spherical'; have: revolute"),
    "words": (spoilt('ixx="1"', 'ixx="one"'), r"must hold numbers, got 'one'"),
    "nan": (spoilt('ixx="1"', 'ixx="nan"'), r"finite"),
    "no axis": (spoilt("'c'/></joint>", "'c'/><axis xyz='0 0 0'/></joint>"), r"'bc'.*length zero"),
    "twice": (robot(AB, BC, LINK.format("a")), r"link 'a' appears twice"),
    "not xml": ("<robot name='r'><link", r"not XML.*line 1"),
    "sdf": ("<sdf/>", r"<sdf>, a URDF has <robot>"),
    "empty": ("", r"not XML"),
    "no joints": ("<robot name='r'><link name='a'/></robot>", r"no joint is left to move"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_files_are_refused_with_the_place_and_the_choices(fault: str, tmp_path: Path) -> None:
    text, message = BAD[fault]
    path = tmp_path / "bad.urdf"
    path.write_text(text)
    joints = ["ab", "bc"] if fault == "planar" else None
    with pytest.raises(ModelError, match=message) as caught, warnings.catch_warnings():
        warnings.simplefilter("error")
        read_urdf(path, joints=joints)
    assert "bad.urdf" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({'mass value="3.228604"': 'mass value="3228.604"'}, "'panda_link3' of 3229 kg; .* grams"),
        ({'izz="0.005433"': 'izz="0.0154"'}, r"no body .* 'panda_link6' \(0.00.*, 0.0155 kg m²\)"),
        (
            {
                '"0.735522"': '"1e-5"',
                '"0.012516"': '"1e-7"',
                '"-0.000428"': '"0"',
                '"-0.001196"': '"0"',
                '"0.010027"': '"1e-7"',
                '"-0.000741"': '"0"',
                '"0.004815"': '"1e-7"',
            },
            r"no torque shows it: joint 'panda_joint7' \(link 'panda_link7' of 1e-05 kg\)",
        ),
    ],
    ids=["grams", "impossible", "next to nothing"],
)
def test_numbers_that_no_link_has_are_told_at_reading(numbers: dict[str, str], told: str) -> None:
    text = PANDA.read_text()
    for number, other in numbers.items():
        assert number in text
        text = text.replace(number, other)
    with pytest.warns(ModelWarning, match=f"arm.urdf: .*{told}") as caught:
        model_from_urdf(text, "arm.urdf")
    assert len(caught) == 1


def test_links_in_grams_are_told_one_by_one() -> None:
    """Also where inertias are in g m²; 17 kg that nobody meant."""
    text = re.sub(r'(mass value|i[xyz][xyz])="([^"]*)"', r'\1="\g<2>e3"', PANDA.read_text())
    text = re.sub(r'e-0(\d)e3"', lambda x: f'e{3 - int(x[1])}"', text)
    with pytest.warns(ModelWarning, match=r"'panda_link4' of 3588 kg, .*; is its mass in grams"):
        model_from_urdf(text)


def test_no_number_of_a_real_robot_is_taken_amiss() -> None:
    paths = [path for folder in ("models", "data") for path in shared(folder).rglob("*.urdf")]
    assert len(paths) >= 5
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for path in paths:
            read_urdf(path)
    said = " ".join(str(x.message) for x in caught)
    assert not any(words in said for words in ("denser", "no body has", "no torque shows it"))


def test_a_joint_that_is_not_there_is_named_with_the_choices() -> None:
    with pytest.raises(ModelError, match=r"'panda_joint9'.*not there.*panda_joint1, panda_joint2"):
        documented("panda", joints=["panda_joint9"])


def test_robots_by_name_and_by_file(tmp_path: Path) -> None:
    assert "panda" in names()
    with pytest.raises(
        ModelError, match=r"'pnada'; have: fr3, panda, a \.urdf.*; did you mean panda\?"
    ):
        documented("pnada")
    with pytest.raises(ModelError, match=r"gone\.urdf"):
        documented(tmp_path / "gone.urdf")
    with pytest.raises(ModelError, match=r"gone\.json"):
        documented(tmp_path / "gone.json")
    model = documented("panda", gravity=[9.81, 0, 0])
    path = save_model(model, tmp_path / "wall.json")
    back = documented(path)
    assert isinstance(back, SelfModel) and back.gravity.tolist() == [9.81, 0, 0]
    older = documented(save_model(replace(model, source=None), path))
    assert older.source is not None and older.source.text == PANDA.read_text()
    other = replace(model, source=None, lam=model.lam + 0.01)
    assert documented(save_model(other, path)).source is None


LIMIT = 'lower="-2.8973" upper="2.8973" velocity="2.175" effort="87"'


@pytest.mark.parametrize(
    ("limit", "told"),
    [
        ('velocity="-1"', "velocity limit must be above .* -1"),
        ('effort="-87"', "effort limit must be above zero.* -87"),
        ('upper="-3"', "limit -2.* lies above its upper one -3"),
        ('effort="nan"', "finite number.*'nan'"),
        ('velocity="inf"', "finite number.*'inf'"),
    ],
)
def test_limits_that_no_joint_has_are_refused(limit: str, told: str) -> None:
    text = PANDA.read_text()
    assert LIMIT in text
    wrong = re.sub(rf'{limit.partition("=")[0]}="[^"]*"', limit, LIMIT)
    with pytest.raises(ModelError, match=rf"arm.urdf: joint 'panda_joint\d'.*{told}"):
        model_from_urdf(text.replace(LIMIT, wrong), "arm.urdf")


def test_a_limit_of_zero_is_not_known() -> None:
    text = PANDA.read_text().replace(LIMIT, 'lower="-1" upper="1" effort="0" velocity="0"')
    with pytest.warns(ModelWarning, match="0 for the speed or effort of panda_joint1, .*not known"):
        limits = model_from_urdf(text).limits
    assert np.isnan(limits.velocity[0]) and np.isnan(limits.effort[0])
    known = documented("panda")
    with pytest.raises(ModelError, match="joint 'panda_joint1': its effort limit must be above"):
        replace(known, limits=replace(known.limits, effort=-known.limits.effort))
